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

import argparse
import os
import resource
import shutil
import signal
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.leagues.served_league import BODY, LEAGUE, publish
from benchmarks.load.callers import WITH_RETRIES, WITHOUT_RETRIES, CallLog, calling
from benchmarks.load.http import post
from benchmarks.load.overload import Overload, overload
from benchmarks.load.slow_clients import slow_clients
from league.registry.aliases import ANY
from league.registry.registry import Registry
from serve_app.runtime.launch import running

REPLICAS = 2
SETTLING = 2.0
"""Seconds of calls before a fault, and after recovery."""
DEADLINE = 90.0
"""Seconds after which recovery has failed."""
SLOW = 200
VICTIMS = ("PolicyServer", "PolicyServer", "PolicyServer", "/haproxy", "ServeController")
"""What is killed before each promotion, in turn."""
HEADER = ("case", "calls", "lost by our client", "lost without retries", "p99 ms", "recovered after s", "target")


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
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with suppress(OSError):
                    first = (entry / "cmdline").read_bytes().split(b"\0")[0]
                    if name.encode() in first and home in (entry / "environ").read_bytes():
                        found.append(int(entry.name))
        return found

    def promote(self) -> None:
        """Move the champion to the other version; returns when all replicas serve it."""
        now = self.registry.aliases.current(LEAGUE)["champion"]
        self.registry.aliases.set(
            LEAGUE, "champion", 3 - now, expected=ANY, actor="benchmark", reason="does it follow?"
        )
        until(lambda: self.serving(3 - now) == REPLICAS)

    def serving(self, version: int) -> int:
        """The number of live replicas that report serving a version."""
        return sum(row.version == version for row in self.registry.replicas.acknowledgements(LEAGUE))


Fault = Callable[[FaultTarget], float]
"""Injects a fault and returns after recovery; the value is the `time.perf_counter` from which recovery was possible."""


def main() -> int:
    """Print a line for each case; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smoke test: faults of a minute last 5 s")
    parser.add_argument("--only", choices=[*FAULTS, *LAST], action="append", help="a case; may be repeated")
    options = parser.parse_args()
    wanted = options.only or [*FAULTS, *LAST]
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch) / "home", versions=2)
        print(" | ".join(HEADER), flush=True)
        with running(registry.storage, replicas=REPLICAS) as url:
            server = FaultTarget(url, registry, 5.0 if options.quick else 60.0)
            until(lambda: server.serving(1) == REPLICAS)
            met = [_report(name, *_inject(server, FAULTS[name], Path(scratch))) for name in FAULTS if name in wanted]
            if "promotions" in wanted:
                _report_confirmations(confirmations(server, count=5 if options.quick else 25))
            if "overload" in wanted:
                met.append(_report_overload(overload(url, seconds=3.0 if options.quick else 10.0)))
        registry.close()
    return int(not all(met))


def _inject(server: FaultTarget, fault: Fault, scratch: Path) -> tuple[CallLog, float]:
    """Inject a fault under load; returns the calls, and the seconds until full recovery."""
    with calling(server.url, scratch) as log:
        time.sleep(SETTLING)
        since = fault(server)
        whole = time.perf_counter()
        time.sleep(SETTLING)
    last = np.concatenate([[whole], log.failed(WITHOUT_RETRIES), log.failed(WITH_RETRIES)]).max()
    return log, float(last - since)


def _report(name: str, log: CallLog, seconds: float) -> bool:
    with_retries, without_retries = len(log.failed(WITH_RETRIES)), len(log.failed(WITHOUT_RETRIES))
    target = "met" if not with_retries else "MISSED (0)"
    print(
        f"{name} | {len(log.calls):,} | {with_retries} | {without_retries} | {log.p99(WITH_RETRIES):.1f} "
        f"| {seconds:.1f} | {target}",
        flush=True,
    )
    for error, count in log.errors.items():
        print(f"    {count} × {error}", flush=True)
    return not with_retries


def _report_confirmations(seconds: list[float]) -> None:
    print(
        f"{len(seconds)} promotions, each after a kill | confirmed by all replicas after: "
        f"median {median(seconds):.2f} s, maximum {max(seconds):.2f} s",
        flush=True,
    )


def _report_overload(result: Overload) -> bool:
    print(
        f"overload, 4× {result.capacity:,.0f}/s | {result.offered:,} | – | {result.other} | {result.p99:.1f} "
        f"({result.p99 / result.p99_before:.2f}× of {result.p99_before:.1f}) | – "
        f"| {'met' if result.is_met else 'MISSED (2×)'}"
    )
    print(
        f"    {result.answered:,} answered, {result.rejected:,} refused with 429, of these "
        f"{result.without_retry_after} without Retry-After; {result.other} anything else   (at most 0)"
    )
    return result.is_met


def until(condition: Callable[[], object]) -> None:
    """Wait for a condition. Raises TimeoutError."""
    deadline = time.monotonic() + DEADLINE
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"the server has not recovered within {DEADLINE:g} s")
        time.sleep(0.02)


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
    now, since = server.registry.aliases.current(LEAGUE)["champion"], time.perf_counter()
    event = server.registry.aliases.set(
        LEAGUE, "champion", 3 - now, expected=ANY, actor="benchmark", reason="is it confirmed?"
    )
    server.registry.changes.wait_for_alias(event, DEADLINE)
    seconds = time.perf_counter() - since
    print(f"    {victim} killed: confirmed after {seconds:.2f} s", flush=True)
    until(lambda: len(set(server.processes(victim)) - {running_before[0]}) >= len(running_before))
    until(lambda: server.serving(3 - now) == REPLICAS)
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
    found = [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in server.processes("/haproxy")]
    return not found or any(b"standin.cfg" in line for line in found)


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
    now = server.registry.aliases.current(LEAGUE)["champion"]
    path = server.registry.artifacts.path(LEAGUE, now)
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
    url = f"{server.url}/v1/policies/{LEAGUE}/action"
    with slow_clients(server.url, post(url, BODY), SLOW):
        time.sleep(max(15.0, server.seconds / 2))
    return time.perf_counter()


def _database(server: FaultTarget) -> Path:
    return server.registry.storage.home / "league.db"


LAST = ("promotions", "overload")
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


if __name__ == "__main__":
    sys.exit(main())
