"""A cluster of three nodes while workers come and go, and the head or the database is lost: what callers see, and for
how long.

Head, two workers, PostgreSQL and Redis each have an address of their own, in network namespaces of one machine, which
requires root, iproute2, PostgreSQL and Redis. The clients call through the node that stays.
"""

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.harness import Parts, Quick, Target, chosen
from tests.support.cluster import league_cluster, scenarios, serving_scenarios
from tests.support.cluster.league_cluster import LeagueCluster

BLOCKS = 300
HTTP_BLOCKS = 32


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Run the scenarios."""
    if (reason := league_cluster.obstacle()) is not None:
        sys.exit(reason)
    for part in chosen(parts, PARTS).values():
        with tempfile.TemporaryDirectory(prefix="cluster-") as name:
            directory = Path(name)
            directory.chmod(0o755)
            with league_cluster.cluster(directory) as cluster:
                scenarios.train(cluster, directory)
                yield from part(cluster, directory, quick)


def _training(cluster: LeagueCluster, directory: Path, _: bool) -> Iterator[Target]:
    changes, steps = scenarios.change_nodes_while_training(cluster, directory)
    yield from _of_nodes("training", changes)
    yield Target(
        "training: versions lost or duplicated", int(steps != sorted(set(steps))), at_most=0, note=f"of {len(steps)}"
    )
    changes, disturbed, undisturbed = scenarios.change_nodes_during_tournament(cluster, BLOCKS)
    yield from _of_nodes("tournament", changes)
    yield Target("tournament: ledgers that differ from an undisturbed one", int(disturbed != undisturbed), at_most=0)


def _of_nodes(work: str, changes: scenarios.Changes) -> Iterator[Target]:
    yield Target(f"{work}: goes on after a worker was killed", round(changes.continued, 1), "s", at_most=60.0)
    yield Target(f"{work}: uses a worker that has joined", round(changes.used, 1), "s", at_most=10.0)
    yield Target(f"{work}: worker drained", round(changes.drained, 1), "s")


def _serving(cluster: LeagueCluster, _: Path, quick: bool) -> Iterator[Target]:
    head_outage, database_outage = (10.0, 10.0) if quick else (30.0, 60.0)
    with _served(cluster) as key:
        ended = serving_scenarios.evaluate_over_http(cluster, key, HTTP_BLOCKS)
        print(f"evaluation over HTTP: {ended['state']}", flush=True)
        calls, killed = serving_scenarios.lose_worker_while_serving(cluster, key)
        yield _lost("worker killed", calls)
        yield Target(
            "worker killed: replicas restored", round(calls.new_replicas(killed)[-1] - killed, 1), "s", at_most=30.0
        )
        calls, ended_at = serving_scenarios.cut_off_database(cluster, key, 2, database_outage)
        yield _lost("no database", calls)
        followed = round(calls.followed(2) - ended_at, 2)
        yield Target("no database: promotion followed after its return", followed, "s", at_most=5.0)
        calls, _, promoted = serving_scenarios.lose_head(cluster, key, 1, head_outage)
        yield _lost("no head", calls)
        yield Target("no head: promotion followed", round(calls.followed(1) - promoted, 2), "s", at_most=1.0)


def _draining(cluster: LeagueCluster, _: Path, __: bool) -> Iterator[Target]:
    """The first loss of a server: later, the worker that has joined again has no replicas."""
    with _served(cluster) as key:
        calls, began, drained = serving_scenarios.drain_worker_while_serving(cluster, key)
        yield _lost("worker drained", calls)
        note = f"{len(calls.new_replicas(began))} replicas started elsewhere"
        yield Target("worker drained under load", round(drained, 1), "s", note=note)


@contextmanager
def _served(cluster: LeagueCluster) -> Iterator[str]:
    cluster.league(cluster.head, "promote", f"{scenarios.LEAGUE}@1", "--yes", "--reason", "benchmark")
    with serving_scenarios.serving(cluster) as key:
        yield key


def _lost(event: str, calls: serving_scenarios.Load) -> Target:
    report = calls.report
    note = (
        f"of {report['calls']:,}, longest {report['longest']:.1f} s; {len(calls.attempts_lost)} of"
        f" {report['attempts']:,} single attempts lost, {len(calls.attempts_shed)} refused"
    )
    return Target(f"{event}: calls of the client lost", len(calls.lost), at_most=0, note=note)


PARTS = {"training": _training, "serving": _serving, "draining": _draining}
"""Each with a cluster of its own."""
