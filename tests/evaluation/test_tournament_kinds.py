"""Evaluations and nightly runs of leagues without two equal sides."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evaluation.gating.nightly import nightly
from evaluation.matches.tournament import evaluate
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues import tictactoe

ROLES = {"adversary": ["adversary_*"], "good": ["agent_*"]}


def league(entry_point: str, **parts: Any) -> LeagueConfig:
    document = {"league": "kind", "environment": {"entry_point": entry_point, "kwargs": {"max_cycles": 12}}}
    return LeagueConfig.from_mapping(document | {"gate": {"elo1": 100, "max_blocks": 200}} | parts)


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    registered = Registry.open(Storage.at(tmp_path / "home"))
    yield registered
    registered.close()


def registered(registry: Registry, config: LeagueConfig) -> LeagueConfig:
    registry.leagues.register(config, interface(config))
    return config


def test_a_nightly_run_with_one_side(registry: Registry) -> None:
    """Version 1 has random weights, version 2 reaches the landmark; they are compared by returns on the same seeds."""
    config = registered(registry, league("mpe2.simple_v3"))
    spaces = registry.leagues.get("kind").interface.of_policy("shared")
    for graph in (tictactoe.linear(spaces, 3), tictactoe.chase_landmark(spaces)):
        tictactoe.publish(registry, graph, "kind")
    report = nightly(config, registry=registry)
    assert report.champion == "kind@2"
    verdict = report.verdicts[-1]
    assert (verdict.outcome, verdict.games) == ("promote", 2 * verdict.blocks)
    assert verdict.difference is not None
    assert verdict.difference.low is not None
    assert verdict.difference.low > 0
    row = registry.verdicts.all("kind")[-1]
    assert row.evidence is not None
    assert len(row.evidence["counts"]) == 3, "a block is one comparison: win, draw or loss"
    assert row.evidence["difference"]["mean"] == verdict.difference.mean


def test_solo_contestants_are_compared_on_common_seeds(registry: Registry) -> None:
    registered(registry, league("mpe2.simple_v3"))
    spaces = registry.leagues.get("kind").interface.of_policy("shared")
    for graph in (tictactoe.linear(spaces, 3), tictactoe.chase_landmark(spaces), tictactoe.chase_landmark(spaces)):
        tictactoe.publish(registry, graph, "kind")
    report = evaluate("kind", registry=registry, blocks=12)
    leaderboard = {standing.ref: standing for standing in report.leaderboard}
    assert (report.scoring, report.by_side, report.games) == ("side", {}, 6 * 12 * 2)
    assert {standing.games for standing in leaderboard.values()} == {3 * 12}
    assert all(0 < (s.unique_games or 0) <= s.games for s in leaderboard.values())
    best, twin, random = (report.payoff.contestants.index(ref) for ref in ("kind@2", "kind@3", "script:random"))
    assert report.payoff.score[best][twin] == pytest.approx(0.5)
    assert report.payoff.score[best][random] == pytest.approx(1.0)
    level, better = report.payoff.difference[best][twin], report.payoff.difference[best][random]
    assert level is not None
    assert better is not None
    assert (level.mean, level.low, level.high) == (0, 0, 0)
    assert better.low is not None
    assert better.low > 0
    assert better.mean == pytest.approx(
        leaderboard["kind@2"].mean_return - leaderboard["script:random"].mean_return, rel=0.5
    )


def test_different_sides_are_rated_separately_and_together(registry: Registry) -> None:
    registered(registry, league("mpe2.simple_adversary_v3", sides=ROLES, policies=ROLES))
    report = evaluate("kind", ["script:random", "script:random", "script:first"], registry=registry, blocks=30)
    assert report.scoring == "side"
    assert set(report.by_side) == {"adversary", "good"}
    for leaderboard in report.by_side.values():
        by_ref = {standing.ref: standing for standing in leaderboard}
        assert by_ref["script:random"].rating == 0
        assert {standing.games for standing in leaderboard} == {30}
        assert sum(standing.score for standing in leaderboard) == pytest.approx(1)
    overall = {standing.ref: standing.score for standing in report.leaderboard}
    for ref, score in overall.items():
        parts = [standing.score for own in report.by_side.values() for standing in own if standing.ref == ref]
        assert sum(parts) / 2 == pytest.approx(score)
    first, other = report.payoff.contestants
    assert report.payoff.by_side["good"][0][1] == next(s.score for s in report.by_side["good"] if s.ref == first)
    assert other in overall


def test_a_free_for_all_is_rated(registry: Registry) -> None:
    config = registered(registry, league("mpe2.simple_spread_v3"))
    spaces = registry.leagues.get("kind").interface.of_policy("shared")
    tictactoe.publish(registry, tictactoe.linear(spaces, 1), "kind")
    report = nightly(config, registry=registry)
    assert report.faults == ()
    assert {standing.ref for standing in report.leaderboard} == {"kind@1", "script:random"}
    assert all(standing.rating is not None for standing in report.leaderboard)
