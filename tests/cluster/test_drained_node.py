"""A worker is drained while it serves. In a cluster of its own: a worker that joins again has no replicas."""

from pathlib import Path

import pytest

from tests.support.cluster import scenarios, serving_scenarios
from tests.support.cluster.league_cluster import LeagueCluster


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_no_attempt_is_lost_with_a_drained_worker(cluster: LeagueCluster, directory: Path) -> None:
    """Replicas are started elsewhere first, and those of the worker finish their requests."""
    scenarios.train(cluster, directory)
    cluster.league(cluster.head, "promote", f"{scenarios.LEAGUE}@1", "--yes", "--reason", "test")
    with serving_scenarios.serving(cluster) as key:
        calls, began, _ = serving_scenarios.drain_worker_while_serving(cluster, key)
    assert calls.lost == calls.attempts_lost == []
    assert len(calls.attempts_shed) < serving_scenarios.RARE * calls.report["attempts"], (
        "while replicas start on the same cores"
    )
    assert calls.new_replicas(began), "others are started elsewhere"
