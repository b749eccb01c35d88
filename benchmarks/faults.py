"""What do callers see when a part of the server is killed, moved, full or overloaded?

A server with two replicas behind HAProxy answers calls without pause, half of them from our client, which retries, half
from a client without retries; in the meantime a fault is injected. Counted are the unanswered calls of each kind, and
the time until full recovery: from the injection, or from the end of a lasting fault. Target: our client loses no call.
Then the champion is promoted again and again, as by `league promote --wait`, right after a replica, HAProxy or the
controller was killed: the time until all replicas have confirmed it.
Overload is measured last: requests arrive at four times the capacity of the server; 99 % of the accepted ones must be
answered within twice the normal time, and all others with 429 and Retry-After.

A full disk is simulated by a limit for the processes of the replicas (RLIMIT_FSIZE of 0), with which each write fails.
"""

import os
import resource
import shutil
import signal
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.attacks.slow_clients import slow_clients
from benchmarks.harness import Parts, Quick, Target, chosen
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, promote, served
from benchmarks.load.callers import WITH_RETRIES, WITHOUT_RETRIES, CallLog, call
from benchmarks.load.elsewhere import beside
from benchmarks.load.http import post
from benchmarks.load.overload import overload
from league.registry.registry import Registry
from tests.support.waiting import until

REPLICAS = 2
SETTLING = 2.0
"""Seconds of calls before a fault, and after recovery."""
DEADLINE = 90.0
"""Seconds that a promotion after a kill may take."""
SLOW = 200
VICTIMS = ("PolicyServer", "PolicyServer", "PolicyServer", "/haproxy", "ServeController")
"""What is killed before each promotion, in turn."""


@dataclass(frozen=True, slots=True)
class FaultTarget:
    """A server, and the duration of lasting faults in seconds."""

    url: str
    registry: Registry
    seconds: float

    def processes(self, name: str) -> list[int]:
        """The processes of this server whose name contains `name`: Ray's actors, and HAProxy, which has its home in its
        environment.
        """
        home = f"LEAGUE_HOME={self.registry.storage.home}\0".encode()
        pids = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with suppress(OSError):
                    first = (entry / "cmdline").read_bytes().split(b"\0")[0]
                    if name.encode() in first and home in (entry / "environ").read_bytes():
                        pids.append(int(entry.name))
        return pids

    def promote(self) -> None:
        """Move the champion to the other version; returns when all replicas serve it."""
        champion = self.registry.aliases.current(LEAGUE)["champion"]
        promote(self.registry, 3 - champion)
        until(lambda: self.serving(3 - champion) == REPLICAS)

    def serving(self, version: int) -> int:
        """The number of live replicas that report serving a version."""
        return sum(row.version == version for row in self.registry.replicas.acknowledgements(LEAGUE))


Fault = Callable[[FaultTarget], float]
"""Injects a fault and returns after recovery; the value is the `time.perf_counter` from which recovery was possible."""


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Inject the faults in turn."""
    cases = chosen(parts, {**FAULTS, "promotions": None, "overload": None})
    with served(2, replicas=REPLICAS) as (url, registry):
        server = FaultTarget(url, registry, 5.0 if quick else 60.0)
        until(lambda: server.serving(1) == REPLICAS)
        for name, fault in cases.items():
            if fault is not None:
                yield from _inject(name, server, fault)
        if "promotions" in cases:
            seconds = confirmations(server, count=5 if quick else 25)
            yield Target("promotion right after a kill, median, maximum", (median(seconds), max(seconds)), "s")
        if "overload" in cases:
            result = overload(url, seconds=3.0 if quick else 10.0)
            note = f"{result.p99:.1f} ms; {result.answered:,} of {result.offered:,} answered, the others refused"
            ratio = result.p99 / result.p99_before
            yield Target("p99 at four times the capacity", ratio, "×", at_most=2.0, peer="at capacity", note=note)
            yield Target("overload: neither answered nor 429", result.other, at_most=0)
            yield Target("overload: 429 without Retry-After", result.without_retry_after, at_most=0)


def _inject(name: str, server: FaultTarget, fault: Fault) -> Iterator[Target]:
    """Inject a fault under load."""
    with beside(call, server.url) as outcome:
        time.sleep(SETTLING)
        since = fault(server)
        whole = time.perf_counter()
        time.sleep(SETTLING)
    log: CallLog = outcome.result
    lost = len(log.failed(WITH_RETRIES))
    last = np.concatenate([[whole], log.failed(WITHOUT_RETRIES), log.failed(WITH_RETRIES)]).max()
    for error, count in log.errors.items():
        print(f"    {count} × {error}", flush=True)
    note = (
        f"of {len(log.calls):,}; {len(log.failed(WITHOUT_RETRIES))} without retries, p99 {log.p99(WITH_RETRIES):.1f} ms"
    )
    yield Target(f"{name}: calls lost by the client", lost, at_most=0, note=note)
    yield Target(f"{name}: recovery", round(last - since, 1), "s")


def _kill(server: FaultTarget, name: str, count: int | None = None) -> float:
    """Kill processes of the server; returns when they have been replaced."""
    running_before = server.processes(name)
    victims = running_before[:count]
    for pid in victims:
        os.kill(pid, signal.SIGKILL)
    since = time.perf_counter()
    until(lambda: len(set(server.processes(name)) - set(victims)) >= len(running_before))
    return since


def replica_killed(server: FaultTarget) -> float:
    """One of two replicas."""
    since = _kill(server, "PolicyServer", 1)
    server.promote()
    return since


def confirmations(server: FaultTarget, count: int) -> list[float]:
    """Kill a process and promote, `count` times; returns the seconds that each promotion was waited for."""
    return [_confirmation(server, VICTIMS[number % len(VICTIMS)]) for number in range(count)]


def _confirmation(server: FaultTarget, victim: str) -> float:
    """Kill a process and promote; returns the seconds waited for, when all processes run again."""
    running_before = server.processes(victim)
    os.kill(running_before[0], signal.SIGKILL)
    champion, since = server.registry.aliases.current(LEAGUE)["champion"], time.perf_counter()
    server.registry.changes.wait_for_alias(promote(server.registry, 3 - champion), DEADLINE)
    seconds = time.perf_counter() - since
    print(f"    {victim} killed: confirmed after {seconds:.2f} s", flush=True)
    until(lambda: len(set(server.processes(victim)) - {running_before[0]}) >= len(running_before))
    until(lambda: server.serving(3 - champion) == REPLICAS)
    return seconds


def controller_killed(server: FaultTarget) -> float:
    """Ray Serve's controller, which replaces dead processes."""
    return _kill(server, "ServeController")


def haproxy_killed(server: FaultTarget) -> float:
    """HAProxy, which all requests pass through."""
    since = _kill(server, "/haproxy")
    until(lambda: not _has_stand_in(server))
    return since


def _has_stand_in(server: FaultTarget) -> bool:
    commands = [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in server.processes("/haproxy")]
    return not commands or any(b"standin.cfg" in command for command in commands)


def manager_killed(server: FaultTarget) -> float:
    """Ray Serve's process that starts HAProxy and configures its replicas; HAProxy ends with it."""
    since = _kill(server, "HAProxyManager")
    until(lambda: not _has_stand_in(server))
    return since


def database_locked(server: FaultTarget) -> float:
    """The database, by a transaction that does not end."""
    blocker = sqlite3.connect(_database(server), isolation_level=None)
    blocker.execute("BEGIN EXCLUSIVE")
    time.sleep(server.seconds)
    blocker.execute("ROLLBACK")
    blocker.close()
    since = time.perf_counter()
    server.promote()
    return since


def database_moved(server: FaultTarget) -> float:
    """The database file, while processes have it open."""
    path = _database(server)
    moved = path.with_suffix(".away")
    path.rename(moved)
    time.sleep(server.seconds)
    assert not path.exists(), "a new database was created"
    moved.rename(path)
    since = time.perf_counter()
    server.promote()
    return since


def home_moved(server: FaultTarget) -> float:
    """The complete directory: database, artifacts and logs."""
    home = server.registry.storage.home
    home.rename(home.with_name("away"))
    time.sleep(server.seconds)
    home.with_name("away").rename(home)
    since = time.perf_counter()
    server.promote()
    return since


def disk_full(server: FaultTarget) -> float:
    """For the replicas."""
    limits = {pid: resource.prlimit(pid, resource.RLIMIT_FSIZE) for pid in server.processes("PolicyServer")}
    for pid, (_, hard) in limits.items():
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, hard))
    time.sleep(server.seconds)
    for pid, limit in limits.items():
        resource.prlimit(pid, resource.RLIMIT_FSIZE, limit)
    since = time.perf_counter()
    server.promote()
    return since


def artefact_deleted(server: FaultTarget) -> float:
    """The files of the served version, and then a replica is killed as well."""
    champion = server.registry.aliases.current(LEAGUE)["champion"]
    path = server.registry.artifacts.path(LEAGUE, champion)
    kept = server.registry.storage.home.with_name("kept")
    shutil.copytree(path, kept)
    shutil.rmtree(path)
    time.sleep(server.seconds)
    shutil.move(kept, path)
    since = time.perf_counter()
    server.promote()
    return since


def clients_slow(server: FaultTarget) -> float:
    """200 clients that send nothing, or single bytes, while others call."""
    with slow_clients(server.url, post(server.url + ACTION, BODY), SLOW):
        time.sleep(max(15.0, server.seconds / 2))
    return time.perf_counter()


def _database(server: FaultTarget) -> Path:
    return server.registry.storage.home / "league.db"


FAULTS: dict[str, Fault] = {
    "replica killed": replica_killed,
    "controller killed": controller_killed,
    "HAProxy killed": haproxy_killed,
    "HAProxy's manager killed": manager_killed,
    "database locked": database_locked,
    "database moved away": database_moved,
    "home moved away": home_moved,
    "disk full": disk_full,
    "artefact deleted": artefact_deleted,
    "slow clients": clients_slow,
}
