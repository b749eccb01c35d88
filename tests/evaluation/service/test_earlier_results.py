"""Results from before a change of the game: what changed, and tables that are kept apart from the current ones."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from evaluation.matches.tournament import evaluate
from evaluation.service.snapshots import earlier_results, refresh
from league.conditions import GameChange
from league.registry.registry import Registry
from league.registry.snapshots import earlier_part
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE

OLD = {"opening_plies": 2, "num_envs": 4}


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """A league with four matches."""
    opened = tictactoe.registry(tmp_path / "home", play=OLD)
    tictactoe.publish(opened, tictactoe.graph(wins=True))
    evaluate(LEAGUE, registry=opened, schedule="gauntlet", against=["script:random"], blocks=4)
    yield opened
    opened.close()


def change(registry: Registry, **play: object) -> None:
    registry.leagues.register(tictactoe.config(play=OLD | play), registry.leagues.get(LEAGUE).interface)


def test_without_a_change_there_are_none(registry: Registry) -> None:
    change(registry, num_envs=2)
    assert earlier_results(registry, registry.leagues.get(LEAGUE)) == []


def test_tables_before_and_after_a_change_are_kept_apart(registry: Registry) -> None:
    refresh(registry, LEAGUE)
    before = registry.snapshots.get(LEAGUE, "leaderboard")
    payoff = registry.snapshots.get(LEAGUE, "payoff")
    assert before is not None
    assert payoff is not None
    change(registry, opening_plies=4)
    refresh(registry, LEAGUE)
    (found,) = earlier_results(registry, registry.leagues.get(LEAGUE))
    assert found.changes == (GameChange("play.opening_plies", "2", "4"),)
    assert (found.matches, found.actions_changed, found.replaced_at is None) == (4, False, False)
    summary, current = (registry.snapshots.get(LEAGUE, part) for part in ("summary", "leaderboard"))
    assert summary is not None
    assert current is not None
    assert summary.document["earlier"] == [found.to_json()]
    assert (summary.document["matches"], current.document["leaderboard"]) == (0, [])
    assert "there is no champion: it has not been tested" in before.document["not_champion"]
    leaderboard = before.document | {"not_champion": None}  # the champion is that of the current game
    for part, document in (("leaderboard", leaderboard), ("payoff", payoff.document)):
        kept = registry.snapshots.get(LEAGUE, earlier_part(found.conditions.name, part))
        assert kept is not None
        assert kept.document == document


def test_a_game_that_returns_counts_again(registry: Registry) -> None:
    change(registry, opening_plies=4)
    change(registry)
    assert earlier_results(registry, registry.leagues.get(LEAGUE)) == []
    assert [game.game["play.opening_plies"] for game in registry.leagues.earlier_games(LEAGUE)] == [4]


def test_another_selection_of_actions_is_named(registry: Registry) -> None:
    change(registry, actions="sampled")
    (found,) = earlier_results(registry, registry.leagues.get(LEAGUE))
    assert (found.conditions.actions, found.actions_changed, found.changes) == ("greedy", True, ())


def test_a_game_without_results_is_recorded(registry: Registry) -> None:
    """A worker that has the configuration from before a change records its matches afterwards."""
    earlier = registry.leagues.get(LEAGUE)
    change(registry, opening_plies=3)
    change(registry, opening_plies=4)
    evaluate(earlier.slug, registry=registry, schedule="gauntlet", against=["script:random"], blocks=2)
    change(registry, opening_plies=5)
    changes = {results.matches: results.changes for results in earlier_results(registry, registry.leagues.get(LEAGUE))}
    assert changes == {
        4: (GameChange("play.opening_plies", "2", "5"),),
        2: (GameChange("play.opening_plies", "4", "5"),),
    }
