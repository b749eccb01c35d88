"""Three nodes with addresses of their own: training, tournaments and serving while nodes are lost, cut off and join.

The tests use one cluster in the order of this file: what one trains, the next ones play and serve.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest

from league.stack import VERIFIED
from tests.support.cluster import scenarios, serving_scenarios
from tests.support.cluster.league_cluster import LeagueCluster

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

BLOCKS = 300
"""Matches of each of two versions against a slow bot."""
HTTP_BLOCKS = 4
HEAD_OUTAGE, DATABASE_OUTAGE = 30.0, 30.0
"""Seconds without a head, and without the database: more than twice as long as its connections wait for packets."""
WAIT = 60.0
"""Seconds for replicas to follow, on shared cores."""


@pytest.mark.e2e
@pytest.mark.timeout(1200)  # less than that of `make test-e2e`
def test_a_learner_runs_where_there_are_cpus(cluster: LeagueCluster, directory: Path) -> None:
    """The driver is on the head, which has none: the learner and its checkpoints are on a worker."""
    output = scenarios.train(cluster, directory)
    assert f"Published {scenarios.LEAGUE}@2" in output


def test_training_uses_the_nodes_that_there_are(cluster: LeagueCluster, directory: Path) -> None:
    """A worker is lost, joins and is drained: the run continues each time, and no version is published twice."""
    _, steps = scenarios.change_nodes_while_training(cluster, directory)
    assert steps == sorted(set(steps))


def test_a_tournament_is_the_same_while_nodes_come_and_go(cluster: LeagueCluster) -> None:
    """A worker is lost, joins and is drained: no match is lost or played twice."""
    _, disturbed, undisturbed = scenarios.change_nodes_during_tournament(cluster, BLOCKS)
    assert disturbed == undisturbed
    assert disturbed.count("\n") == 2 * BLOCKS


def test_a_node_with_another_version_is_refused(cluster: LeagueCluster, directory: Path) -> None:
    said = scenarios.join_with_another_version(cluster, directory, "onnxruntime", "1.2.3")
    assert f"has onnxruntime 1.2.3, this one has {VERIFIED['onnxruntime']}" in said


def test_no_attempt_is_lost_with_a_drained_worker(cluster: LeagueCluster) -> None:
    """Replicas are started elsewhere first, and those of the worker finish their requests.

    The server is not that of the following tests: a worker that joins again has no replicas.
    """
    cluster.league(cluster.head, "promote", f"{scenarios.LEAGUE}@1", "--yes", "--reason", "test")
    with serving_scenarios.serving(cluster) as key:
        calls, began, _ = serving_scenarios.drain_worker_while_serving(cluster, key)
    assert calls.lost == calls.attempts_lost == []
    assert len(calls.attempts_shed) < serving_scenarios.RARE * calls.report["attempts"], (
        "while replicas start on the same cores"
    )
    assert calls.new_replicas(began), "others are started elsewhere"


@pytest.fixture(scope="module")
def key(cluster: LeagueCluster) -> Iterator[str]:
    with serving_scenarios.serving(cluster) as token:
        yield token


def test_evaluations_over_http_are_played(cluster: LeagueCluster, key: str) -> None:
    """Through a node that need not have the evaluation service."""
    ended = serving_scenarios.evaluate_over_http(cluster, key, HTTP_BLOCKS)
    assert (ended["state"], ended["error"]) == ("done", None)
    assert {f"{scenarios.LEAGUE}@1", f"{scenarios.LEAGUE}@2"} <= {
        standing["ref"] for standing in ended["result"]["leaderboard"]
    }


def test_a_promotion_waits_for_the_replicas_of_all_nodes(cluster: LeagueCluster, key: str) -> None:
    """`promote --wait` on a worker, for each of two versions."""
    for version in (2, 1):
        said = serving_scenarios.promote_and_wait(cluster, version, WAIT)
        assert f"Confirmed by {serving_scenarios.REPLICAS} replicas." in said


def test_no_call_is_lost_with_a_worker(cluster: LeagueCluster, key: str) -> None:
    calls, killed = serving_scenarios.lose_worker_while_serving(cluster, key)
    assert calls.lost == []
    assert len(calls.attempts_lost) <= serving_scenarios.THREADS, "no more than those in flight"
    assert len(calls.attempts_shed) < serving_scenarios.RARE * calls.report["attempts"], (
        "while replicas start on the same cores"
    )
    assert calls.new_replicas(killed), "others are started elsewhere"


def test_no_call_is_lost_with_the_database(cluster: LeagueCluster, key: str) -> None:
    calls, _ = serving_scenarios.cut_off_database(cluster, key, 2, DATABASE_OUTAGE)
    assert calls.lost == []
    assert not calls.attempts_lost, calls.losses()
    assert len(calls.attempts_shed) < serving_scenarios.RARE * calls.report["attempts"], (
        "while a command starts on the same cores"
    )
    assert calls.versions() == ["1", "2"], "promoted meanwhile, followed afterwards"


def test_no_call_is_lost_with_the_head(cluster: LeagueCluster, key: str) -> None:
    calls, killed, _ = serving_scenarios.lose_head(cluster, key, 1, HEAD_OUTAGE)
    assert calls.lost == []
    assert not calls.attempts_lost, f"killed at {killed}\n{calls.losses()}"
    assert len(calls.attempts_shed) < serving_scenarios.RARE * calls.report["attempts"], (
        "while a head starts on the same cores"
    )
    assert calls.versions() == ["2", "1"], "promoted meanwhile"
    assert calls.new_replicas(killed) == [], "replicas continue"
