"""What happens to a cluster that serves, and what callers see: nodes that are killed, cut off and drained.

The slow tests assert the results, and `benchmarks/cluster.py` prints them.
"""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.cluster.league_cluster import HEAD, START_TIMEOUT, LeagueCluster
from tests.support.cluster.machines import Machine, end
from tests.support.cluster.scenarios import LEAGUE, LOST, SURVIVOR, drain, restart
from tests.support.waiting import until

REPLICAS = 4
THREADS = 2
AFTERWARDS = 20.0
"""Seconds of load after the head is back: it must not replace replicas."""
SETTLED = 3.0
"""Seconds after which all replicas have answered many calls."""
RARE = 0.001
"""Share of attempts that may be refused with 429 while replicas or a head start on the same cores."""
PORT = 8000


@dataclass(frozen=True)
class Load:
    """What callers see while something happens. Times are seconds since the epoch."""

    file: Path

    @property
    def report(self) -> dict[str, Any]:
        """The report of `caller.py` so far."""
        return dict(json.loads(self.file.read_text())) if self.file.exists() else {"replicas": {}, "versions": {}}

    @property
    def lost(self) -> list[str]:
        """Calls of the client that failed in spite of its retries."""
        return list(self.report["lost"])

    @property
    def attempts_lost(self) -> list[str]:
        """Single attempts that failed."""
        return list(self.report["attempts_lost"])

    @property
    def attempts_shed(self) -> list[str]:
        """Single attempts that an overloaded replica refused with 429."""
        return list(self.report["attempts_shed"])

    def losses(self) -> str:
        """The failures of single attempts: how many, since when and until when, by what was responded."""
        times: dict[str, list[str]] = {}
        for failure in self.attempts_lost:
            time, _, response = failure.partition(" ")
            times.setdefault(response, []).append(time)
        return "\n".join(f"{len(of)} from {min(of)} to {max(of)}: {number}" for number, of in times.items())

    def versions(self) -> list[str]:
        """The versions that answered, in the order of their first answers."""
        result = self.report["versions"]
        return sorted(result, key=lambda version: float(result[version][0]))

    def followed(self, version: int) -> float:
        """When a version other than this one answered for the last time."""
        return max(float(last) for other, (_, last) in self.report["versions"].items() if other != str(version))

    def new_replicas(self, since: float) -> list[float]:
        """When replicas that had not answered before `since` answered first."""
        return sorted(first for first, _ in self.report["replicas"].values() if first > since)

    def wait_for_replicas(self, since: float = 0) -> None:
        """Wait until REPLICAS have answered since a time."""
        until(lambda: sum(last > since for _, last in self.report["replicas"].values()) >= REPLICAS, START_TIMEOUT)

    def wait_for_version(self, version: int) -> None:
        """Wait until a version answers, and no other has for SETTLED seconds."""
        until(lambda: str(version) in self.report["versions"], START_TIMEOUT)
        until(lambda: time.time() > self.followed(version) + SETTLED, START_TIMEOUT)


@contextmanager
def serving(cluster: LeagueCluster) -> Iterator[str]:
    """Serve on all nodes; yields a new API key."""
    scopes, name = ("--scope", "act", "--scope", "read", "--scope", "evaluate"), f"clients-{time.time_ns()}"
    token = json.loads(cluster.league(cluster.head, "keys", "create", name, *scopes, "--json"))["key"]
    options = ("--host", "0.0.0.0", "--replicas", str(REPLICAS), "--address", cluster.address)
    before = len(cluster.head.log.read_text())
    server = cluster.start_league(cluster.head, "serve", *options)
    try:
        until(
            lambda: "Serving" in cluster.head.log.read_text()[before:] or server.poll() is not None, 2 * START_TIMEOUT
        )
        assert server.poll() is None, cluster.head.log.read_text()[-3000:]
        yield token
    finally:
        end(server, 60)


@contextmanager
def load(cluster: LeagueCluster, key: str, through: str = SURVIVOR) -> Iterator[Load]:
    """Call the server through one machine's HAProxy while the context lasts, from when all replicas have answered."""
    client = cluster.machines["client"]
    result = Load(client.log.with_name(f"caller-{time.time_ns()}.json"))
    url = f"http://{cluster.machines[through].address}:{PORT}"
    program = (sys.executable, "-m", "tests.support.cluster.caller", url, key, LEAGUE, str(THREADS), str(result.file))
    process = client.start(*program, environment=cluster.environment)
    try:
        result.wait_for_replicas()
        yield result
    finally:
        end(process, 120)


def lose_worker_while_serving(cluster: LeagueCluster, key: str) -> tuple[Load, float]:
    """Kill a worker under load until as many replicas answer again; returns the load and when it was killed."""
    with load(cluster, key) as calls:
        cluster.machines[LOST].kill()
        killed = time.time()
        calls.wait_for_replicas(since=killed)
    restart(cluster, LOST)
    return calls, killed


def drain_worker_while_serving(cluster: LeagueCluster, key: str) -> tuple[Load, float, float]:
    """Drain a worker under load; returns the load, when that began and how long the worker's Ray needed to end."""
    with load(cluster, key) as calls:
        began = time.time()
        drained = drain(cluster, LOST)
        calls.wait_for_replicas(since=began + drained)
    restart(cluster, LOST)
    return calls, began, drained


def evaluate_over_http(cluster: LeagueCluster, key: str, blocks: int) -> dict[str, Any]:
    """Start an evaluation through a worker's HAProxy and follow it to its end; returns what the server says then."""
    program = (sys.executable, "-m", "tests.support.cluster.evaluation_caller")
    url = f"http://{cluster.machines[SURVIVOR].address}:{PORT}"
    client = cluster.machines["client"]
    printed = client.check_run(*program, url, key, LEAGUE, str(blocks), environment=cluster.environment, timeout=240)
    return dict(json.loads(printed))


def lose_head(cluster: LeagueCluster, key: str, version: int, seconds: float) -> tuple[Load, float, float]:
    """Kill the head, promote a version meanwhile, start it again; returns the load, the kill and the promotion."""
    with load(cluster, key) as calls:
        cluster.head.kill()
        killed = time.time()
        promoted = promote(cluster, cluster.machines[SURVIVOR], version)
        calls.wait_for_version(version)
        until(lambda: time.time() >= killed + seconds, seconds + START_TIMEOUT)
        restart(cluster, HEAD)
        returned = time.time()
        until(lambda: time.time() >= returned + AFTERWARDS, 2 * AFTERWARDS)
    return calls, killed, promoted


def cut_off_database(cluster: LeagueCluster, key: str, version: int, seconds: float) -> tuple[Load, float]:
    """Cut the database off, and promote on its machine meanwhile; returns the load and the end of the partition."""
    database = cluster.machines["database"]
    with load(cluster, key) as calls:
        began = time.time()
        with database.unplugged():
            promote(cluster, database, version)
            until(lambda: time.time() >= began + seconds, seconds + START_TIMEOUT)
        restored = time.time()
        calls.wait_for_version(version)
    return calls, restored


def promote_and_wait(cluster: LeagueCluster, version: int, seconds: float) -> str:
    """Promote a version on a worker, and wait until all replicas serve it; returns what the command prints."""
    options = ("--reason", "test", "--wait", "--timeout", str(seconds))
    return cluster.league(cluster.machines[SURVIVOR], "promote", f"{LEAGUE}@{version}", "--yes", *options)


def promote(cluster: LeagueCluster, machine: Machine, version: int) -> float:
    """Promote a version by a command on a machine; returns when it took effect."""
    cluster.league(machine, "promote", f"{LEAGUE}@{version}", "--yes", "--reason", "test")
    return float(cluster.sql("SELECT extract(epoch FROM max(at)) FROM alias_events"))
