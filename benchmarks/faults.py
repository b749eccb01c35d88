"""What do callers see when a part of the server is killed, taken away, filled up or overrun?

A server with two replicas behind HAProxy answers calls without a pause, half of them of our client, which tries again,
half of a client that tries once; meanwhile it is hurt. Counted are the calls of each that were not answered, and how
long it took until all was as before: from the blow, or from the end of a fault that lasts. Target: our client loses
none. Overload is measured at its end: requests arrive at four times the rate that the server can take; of those that it
accepts 99 % must be answered within twice the time of before, and the others with 429 and Retry-After.

A full disk is a limit for the replicas' processes (RLIMIT_FSIZE of 0): whatever they write fails, as on a full one.
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

import numpy as np

from benchmarks.callers import ONCE, OURS, Seen, calling
from benchmarks.load import post
from benchmarks.overload import Overload, overload
from benchmarks.served_league import BODY, LEAGUE, publish
from benchmarks.slow_clients import slow_clients
from league.registry.aliases import ANY
from league.registry.registry import Registry
from serve_app.launch import running

REPLICAS = 2
STEADY = 2.0
"""Seconds of calls before a blow, and after all is as before."""
WHOLE = 90.0
"""Seconds after which what has not recovered is given up."""
SLOW = 200
HEADER = ("case", "calls", "lost by our client", "lost without retries", "p99 ms", "recovered after s", "target")


@dataclass(frozen=True, slots=True)
class Stage:
    """A server, and for how long faults that last do."""

    url: str
    registry: Registry
    seconds: float

    def processes(self, name: str) -> list[int]:
        """The processes of this server whose name has that in it: Ray's actors and HAProxy have its home in their
        environment."""
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
        """Move the champion to the other version, and return when every replica serves it."""
        now = self.registry.aliases(LEAGUE)["champion"]
        self.registry.set_alias(LEAGUE, "champion", 3 - now, expected=ANY, actor="benchmark", reason="does it follow?")
        until(lambda: self.serving(3 - now) == REPLICAS)

    def serving(self, version: int) -> int:
        """How many replicas that live say that they serve a version."""
        return sum(said.version == version for said in self.registry.acknowledgements(LEAGUE))


Blow = Callable[[Stage], float]
"""Hurts a server and returns when it is as before; the value: `time.perf_counter` since when it could recover."""


def main() -> int:
    """Print a line for each case; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="what lasts a minute lasts 5 s: shows that it works")
    parser.add_argument("--only", choices=[*BLOWS, "overload"], action="append", help="a case; may be repeated")
    options = parser.parse_args()
    wanted = options.only or [*BLOWS, "overload"]
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch) / "home", versions=2)
        print(" | ".join(HEADER), flush=True)
        with running(registry.storage, replicas=REPLICAS) as url:
            stage = Stage(url, registry, 5.0 if options.quick else 60.0)
            until(lambda: stage.serving(1) == REPLICAS)
            met = [_tell(name, *_strike(stage, BLOWS[name], Path(scratch))) for name in BLOWS if name in wanted]
            if "overload" in wanted:
                met.append(_tell_overload(overload(url, seconds=3.0 if options.quick else 10.0)))
        registry.close()
    return int(not all(met))


def _strike(stage: Stage, blow: Blow, scratch: Path) -> tuple[Seen, float]:
    """Hurt a server under load; what callers saw, and the seconds until all was as before."""
    with calling(stage.url, scratch) as seen:
        time.sleep(STEADY)
        since = blow(stage)
        whole = time.perf_counter()
        time.sleep(STEADY)
    last = np.concatenate([[whole], seen.failed(ONCE), seen.failed(OURS)]).max()
    return seen, float(last - since)


def _tell(name: str, seen: Seen, seconds: float) -> bool:
    ours, once = len(seen.failed(OURS)), len(seen.failed(ONCE))
    target = "met" if not ours else "MISSED (0)"
    print(
        f"{name} | {len(seen.calls):,} | {ours} | {once} | {seen.p99(OURS):.1f} | {seconds:.1f} | {target}", flush=True
    )
    for error, count in seen.errors.items():
        print(f"    {count} × {error}", flush=True)
    return not ours


def _tell_overload(seen: Overload) -> bool:
    print(
        f"overload, 4× {seen.capacity:,.0f}/s | {seen.offered:,} | – | {seen.other} | {seen.p99:.1f} "
        f"({seen.p99 / seen.p99_before:.2f}× of {seen.p99_before:.1f}) | – | {'met' if seen.is_met else 'MISSED (2×)'}"
    )
    print(
        f"    {seen.answered:,} answered, {seen.refused:,} refused with 429, of these {seen.without_retry_after} "
        f"without Retry-After; {seen.other} anything else   (at most 0)"
    )
    return seen.is_met


def until(condition: Callable[[], object]) -> None:
    """Wait for a condition. Raises TimeoutError."""
    deadline = time.monotonic() + WHOLE
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"the server has not recovered within {WHOLE:g} s")
        time.sleep(0.02)


def _kill(stage: Stage, name: str, count: int | None = None) -> float:
    """Kill processes of the server; return when as many new ones are there."""
    before = stage.processes(name)
    victims = before[:count]
    for pid in victims:
        os.kill(pid, signal.SIGKILL)
    since = time.perf_counter()
    until(lambda: len(set(stage.processes(name)) - set(victims)) >= len(before))
    return since


def replica_killed(stage: Stage) -> float:
    """One of two."""
    since = _kill(stage, "PolicyServer", 1)
    stage.promote()
    return since


def controller_killed(stage: Stage) -> float:
    """Ray Serve's, which replaces what dies."""
    return _kill(stage, "ServeController")


def haproxy_killed(stage: Stage) -> float:
    """What all requests go through."""
    since = _kill(stage, "/haproxy")
    until(lambda: not _stands_in(stage))
    return since


def _stands_in(stage: Stage) -> bool:
    found = [Path(f"/proc/{pid}/cmdline").read_bytes() for pid in stage.processes("/haproxy")]
    return not found or any(b"standin.cfg" in line for line in found)


def manager_killed(stage: Stage) -> float:
    """Ray Serve's process that starts HAProxy and tells it of replicas; HAProxy dies with it."""
    since = _kill(stage, "HAProxyManager")
    until(lambda: not _stands_in(stage))
    return since


def database_locked(stage: Stage) -> float:
    """By a transaction that does not end."""
    blocker = sqlite3.connect(_database(stage), isolation_level=None)
    blocker.execute("BEGIN EXCLUSIVE")
    time.sleep(stage.seconds)
    blocker.execute("ROLLBACK")
    blocker.close()
    since = time.perf_counter()
    stage.promote()
    return since


def database_moved(stage: Stage) -> float:
    """Its file, under the feet of those who have it open."""
    path = _database(stage)
    away = path.with_suffix(".away")
    path.rename(away)
    time.sleep(stage.seconds)
    assert not path.exists(), "somebody has made another database"
    away.rename(path)
    since = time.perf_counter()
    stage.promote()
    return since


def home_moved(stage: Stage) -> float:
    """The whole directory: database, artefacts and logs."""
    home = stage.registry.storage.home
    home.rename(home.with_name("away"))
    time.sleep(stage.seconds)
    home.with_name("away").rename(home)
    since = time.perf_counter()
    stage.promote()
    return since


def disk_full(stage: Stage) -> float:
    """For the replicas."""
    limits = {pid: resource.prlimit(pid, resource.RLIMIT_FSIZE) for pid in stage.processes("PolicyServer")}
    for pid, (_, hard) in limits.items():
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, hard))
    time.sleep(stage.seconds)
    for pid, limit in limits.items():
        resource.prlimit(pid, resource.RLIMIT_FSIZE, limit)
    since = time.perf_counter()
    stage.promote()
    return since


def artefact_deleted(stage: Stage) -> float:
    """The files of the version that answers, and then that of a replica besides."""
    now = stage.registry.aliases(LEAGUE)["champion"]
    path = stage.registry.artifacts.path(LEAGUE, now)
    kept = stage.registry.storage.home.with_name("kept")
    shutil.copytree(path, kept)
    shutil.rmtree(path)
    time.sleep(stage.seconds)
    shutil.move(kept, path)
    since = time.perf_counter()
    stage.promote()
    return since


def clients_slow(stage: Stage) -> float:
    """200 that are silent, or dribble, while others call."""
    url = f"{stage.url}/v1/policies/{LEAGUE}/action"
    with slow_clients(stage.url, post(url, BODY), SLOW):
        time.sleep(max(15.0, stage.seconds / 2))
    return time.perf_counter()


def _database(stage: Stage) -> Path:
    return stage.registry.storage.home / "league.db"


BLOWS: dict[str, Blow] = {
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
