"""A cluster of three nodes while workers come and go, and the head or the database is lost: what callers see, and for
how long.

Head, two workers, PostgreSQL and Redis each have an address of their own, in network namespaces of one machine, which
requires root, iproute2, PostgreSQL and Redis. The clients call through the node that stays.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.support.cluster import league_cluster, scenarios, serving_scenarios
from tests.support.cluster.league_cluster import LeagueCluster

BLOCKS = 300
HTTP_BLOCKS = 32


def main() -> int:
    """Run all scenarios and print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="outages of 10 s instead of 30 and 60 s")
    quick = parser.parse_args().quick
    if (reason := league_cluster.obstacle()) is not None:
        print(reason, file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="cluster-") as name:
        directory = Path(name)
        directory.chmod(0o755)
        with league_cluster.cluster(directory) as cluster:
            _training(cluster, directory)
            _serving(cluster, *((10.0, 10.0) if quick else (30.0, 60.0)))
    return 0


def _training(cluster: LeagueCluster, directory: Path) -> None:
    scenarios.train(cluster, directory)
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


def _serving(cluster: LeagueCluster, head_outage: float, database_outage: float) -> None:
    cluster.league(cluster.head, "promote", f"{scenarios.LEAGUE}@1", "--reason", "benchmark")
    with serving_scenarios.serving(cluster) as key:
        ended = serving_scenarios.evaluate_over_http(cluster, key, HTTP_BLOCKS)
        print(f"evaluation over HTTP: {ended['state']}", flush=True)
        calls, killed = serving_scenarios.lose_worker_while_serving(cluster, key)
        restored = calls.new_replicas(killed)[-1] - killed
        print(f"worker killed under load: {_losses(calls)}; replicas restored after {restored:.1f} s", flush=True)
        calls, _, drained = serving_scenarios.drain_worker_while_serving(cluster, key)
        print(f"worker drained under load: {_losses(calls)}; drained within {drained:.1f} s", flush=True)
        calls, ended_at = serving_scenarios.cut_off_database(cluster, key, 2, database_outage)
        followed = calls.followed(2) - ended_at
        print(f"no database for {database_outage:g} s: {_losses(calls)}; followed {followed:.2f} s later", flush=True)
        calls, killed, promoted = serving_scenarios.lose_head(cluster, key, 1, head_outage)
        followed, replaced = calls.followed(1) - promoted, len(calls.new_replicas(killed))
        print(f"no head for {head_outage:g} s: {_losses(calls)}; new replicas: {replaced}")
        print(f"promotion without a head: followed after {followed:.2f} s", flush=True)


def _losses(calls: serving_scenarios.Load) -> str:
    report = calls.report
    return (
        f"{len(calls.lost)} of {report['calls']:,} calls of the client and {len(calls.attempts_lost)} of"
        f" {report['attempts']:,} single attempts lost, {len(calls.attempts_shed)} refused"
        f" with 429, longest call {report['longest']:.1f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
