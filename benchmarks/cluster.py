"""A cluster of three nodes while workers come and go, and the head or the database is lost: what callers see, and for
how long.

Head, two workers, PostgreSQL and Redis each have an address of their own, in network namespaces of one machine, which
requires root, iproute2, PostgreSQL and Redis. The clients call through the node that stays.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.cluster import league_cluster, scenarios, serving_scenarios
from tests.support.cluster.league_cluster import LeagueCluster

BLOCKS = 300
HTTP_BLOCKS = 32


def main() -> int:
    """Run the scenarios and print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; default: all")
    parser.add_argument("--quick", action="store_true", help="outages of 10 s instead of 30 and 60 s")
    options = parser.parse_args()
    if unknown := [part for part in options.parts if part not in PARTS]:
        parser.error(f"no part {', '.join(unknown)}: expected some of {', '.join(PARTS)}")
    if (reason := league_cluster.obstacle()) is not None:
        print(reason, file=sys.stderr)
        return 2
    for part in options.parts or PARTS:
        with tempfile.TemporaryDirectory(prefix="cluster-") as name:
            directory = Path(name)
            directory.chmod(0o755)
            with league_cluster.cluster(directory) as cluster:
                scenarios.train(cluster, directory)
                PARTS[part](cluster, directory, options.quick)
    return 0


def _training(cluster: LeagueCluster, directory: Path, _: bool) -> None:
    changes, steps = scenarios.change_nodes_while_training(cluster, directory)
    print(
        f"training: {_described(changes)}; {len(steps)} versions, each once: {steps == sorted(set(steps))}", flush=True
    )
    changes, disturbed, undisturbed = scenarios.change_nodes_during_tournament(cluster, BLOCKS)
    print(f"tournament: {_described(changes)}; ledger identical: {disturbed == undisturbed}", flush=True)


def _described(changes: scenarios.Changes) -> str:
    return (
        f"went on {changes.continued:.1f} s after a worker was killed; used a worker {changes.used:.1f} s after it had"
        f" joined; worker drained within {changes.drained:.1f} s"
    )


def _serving(cluster: LeagueCluster, _: Path, quick: bool) -> None:
    head_outage, database_outage = (10.0, 10.0) if quick else (30.0, 60.0)
    with _served(cluster) as key:
        ended = serving_scenarios.evaluate_over_http(cluster, key, HTTP_BLOCKS)
        print(f"evaluation over HTTP: {ended['state']}", flush=True)
        calls, killed = serving_scenarios.lose_worker_while_serving(cluster, key)
        restored = calls.new_replicas(killed)[-1] - killed
        print(f"worker killed under load: {_losses(calls)}; replicas restored after {restored:.1f} s", flush=True)
        calls, ended_at = serving_scenarios.cut_off_database(cluster, key, 2, database_outage)
        followed = calls.followed(2) - ended_at
        print(f"no database for {database_outage:g} s: {_losses(calls)}; followed {followed:.2f} s later", flush=True)
        calls, killed, promoted = serving_scenarios.lose_head(cluster, key, 1, head_outage)
        followed, replaced = calls.followed(1) - promoted, len(calls.new_replicas(killed))
        print(f"no head for {head_outage:g} s: {_losses(calls)}; new replicas: {replaced}")
        print(f"promotion without a head: followed after {followed:.2f} s", flush=True)


def _draining(cluster: LeagueCluster, _: Path, __: bool) -> None:
    """The first loss of a server: later, the worker that has joined again has no replicas."""
    with _served(cluster) as key:
        calls, began, drained = serving_scenarios.drain_worker_while_serving(cluster, key)
        print(
            f"worker drained under load: {_losses(calls)}; {len(calls.new_replicas(began))} replicas started elsewhere;"
            f" drained within {drained:.1f} s",
            flush=True,
        )


@contextmanager
def _served(cluster: LeagueCluster) -> Iterator[str]:
    cluster.league(cluster.head, "promote", f"{scenarios.LEAGUE}@1", "--yes", "--reason", "benchmark")
    with serving_scenarios.serving(cluster) as key:
        yield key


def _losses(calls: serving_scenarios.Load) -> str:
    report = calls.report
    return (
        f"{len(calls.lost)} of {report['calls']:,} calls of the client and {len(calls.attempts_lost)} of"
        f" {report['attempts']:,} single attempts lost, {len(calls.attempts_shed)} refused"
        f" with 429, longest call {report['longest']:.1f} s"
    )


PARTS = {"training": _training, "serving": _serving, "draining": _draining}
"""Each with a cluster of its own."""


if __name__ == "__main__":
    sys.exit(main())
