"""Strength of a run's versions: recorded once, read in the order of the versions."""

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from league.errors import UnknownLeague
from league.registry.registry import Registry
from league.registry.storage.rows import StrengthRow
from tests.support.leagues.registries import LEAGUE, publish

ROW = StrengthRow(
    league=LEAGUE,
    version=1,
    opponent="script:random",
    run="first",
    steps=512,
    games=200,
    score=0.75,
    low=0.68,
    high=0.81,
    at=datetime(2026, 11, 24, tzinfo=UTC),
)


def test_scores_are_read_by_run_in_the_order_of_the_versions(registry: Registry) -> None:
    for run in ("first/1", "first/2", "second/1"):
        publish(registry, run)
    later, other = replace(ROW, version=2, steps=1024), replace(ROW, version=3, run="second")
    registry.strength.record([later])
    registry.strength.record([ROW])
    registry.strength.record([other])
    assert registry.strength.of_run(LEAGUE, "first") == [ROW, later]
    assert registry.strength.of_run(LEAGUE, "second") == [other]
    assert registry.strength.of_run(LEAGUE, "third") == []


def test_a_repeated_measurement_keeps_the_first_score(registry: Registry) -> None:
    publish(registry, "first/1")
    registry.strength.record([ROW])
    anchor = replace(ROW, opponent="script:one_ply", score=0.5)
    registry.strength.record([replace(ROW, score=0.1), anchor])
    found = registry.strength.of_run(LEAGUE, "first")
    assert sorted((row.opponent, row.score) for row in found) == [("script:one_ply", 0.5), ("script:random", 0.75)]


def test_an_unknown_league_is_named(registry: Registry) -> None:
    with pytest.raises(UnknownLeague, match="chess"):
        registry.strength.of_run("chess", "first")
