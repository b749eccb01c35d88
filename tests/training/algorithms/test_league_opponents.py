"""The candidates of a run, its scores against them, and the draws."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ray.rllib.utils.metrics import NUM_EPISODES

from league.config.opponents import OpponentConfig
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import EXPLOITER, Manifest
from league.results.ledger import Ledger
from league.results.payoffs import PRIOR_GAMES, payoff_matrix
from league.results.records import Outcome
from league.results.sums import GameSums, PairSums
from league.settings import Storage
from tests.support.leagues import registries
from training.algorithms.league_opponents import HALF_LIFE, LeagueOpponents


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    return registries.registered(Registry.open(Storage.at(tmp_path)))


def opponents_of(registry: Registry, *fixed: str, **league: Any) -> LeagueOpponents:
    parts = {"fixed": [{"ref": ref, "share": 0.1} for ref in fixed], "league": league}
    config = registries.config().with_training(opponents=parts)
    return LeagueOpponents(config, registries.interface(), registry.storage)


def refreshed(registry: Registry, *fixed: str, **league: Any) -> LeagueOpponents:
    opponents = opponents_of(registry, *fixed, **league)
    opponents.refresh()
    return opponents


def publish(registry: Registry, count: int) -> None:
    for number in range(count):
        registries.publish(registry, f"run/{len(registry.versions.all('tictactoe'))}/{number}")


def promote(registry: Registry, number: int) -> None:
    registry.aliases.set("tictactoe", "champion", number, expected=ANY, actor="me", reason="test")


def refs(*numbers: int) -> tuple[str, ...]:
    return tuple(f"tictactoe@{number}" for number in numbers)


def metrics(episodes: float = 0.0, **results: tuple[float, float]) -> list[dict[str, Any]]:
    """Of one runner: its episodes, and version number → (games, score). All games are scored."""
    return unscored(episodes, {ref: (games, games, score) for ref, (games, score) in results.items()})


def unscored(total: float, results: dict[str, tuple[float, float, float]]) -> list[dict[str, Any]]:
    """Of one runner: its episodes, and version number → (episodes, scored games, score)."""
    names = ("episodes", "games", "score")
    played = {f"tictactoe@{ref[1:]}": dict(zip(names, values, strict=True)) for ref, values in results.items()}
    return [{NUM_EPISODES: total, "opponents": played}]


def publish_exploiter(registry: Registry, target: int) -> None:
    build = registries.builder()

    def build_exploiter(directory: Path, number: int) -> Manifest:
        return build(directory, number).model_copy(update={"role": EXPLOITER, "exploits": f"tictactoe@{target}"})

    source = f"exploiter/{len(registry.versions.all('tictactoe'))}"
    registry.publisher.publish("tictactoe", build_exploiter, source=source, parent=None)


def test_an_empty_league_has_no_opponents(registry: Registry) -> None:
    opponents = refreshed(registry)
    opponents.reset(0)
    assert opponents.active == ()
    publish(registry, 1)
    opponents.refresh()
    opponents.reset(1000)
    assert [(opponent.ref, opponent.share) for opponent in opponents.active] == [("tictactoe@1", 0.5)]


def test_candidates_are_the_newest_versions_and_all_champions(registry: Registry) -> None:
    publish(registry, 7)
    for champion in (1, 2):
        promote(registry, champion)
    assert refreshed(registry, window=2).candidates == refs(1, 2, 6, 7)
    assert refreshed(registry, "tictactoe@7", window=2, champions=False).candidates == refs(6)


def test_of_mixtures_and_search_versions_what_they_play_are_candidates(registry: Registry) -> None:
    publish(registry, 6)
    promote(registry, registry.publisher.publish_mixture("tictactoe", {1: 0.5, 3: 0.5}).number)
    assert refreshed(registry, window=2).candidates == refs(1, 3, 5, 6)
    promote(registry, registry.publisher.publish_search("tictactoe", 2, "puct", 8, 1.0).number)
    assert refreshed(registry, window=1).candidates == refs(1, 2, 3, 6)


def test_the_newest_exploiters_of_champions_are_candidates(registry: Registry) -> None:
    publish(registry, 1)
    for target in (1, 1, 2):
        publish_exploiter(registry, target)
    publish(registry, 2)
    promote(registry, 1)
    assert refreshed(registry, window=1, champions=False).candidates == refs(3, 6)
    assert refreshed(registry, window=3, champions=False, exploiters=False).candidates == refs(1, 5, 6)


def test_versions_with_another_interface_are_no_candidates(registry: Registry) -> None:
    publish(registry, 1)
    config = registries.config().with_training(opponents={"league": {}})
    opponents = LeagueOpponents(config, registries.interface(squares=8), registry.storage)
    opponents.refresh()
    assert opponents.candidates == ()


def test_scores_decay_towards_the_prior(registry: Registry) -> None:
    opponents = opponents_of(registry)
    opponents.add(metrics(v1=(20.0, 20.0), v2=(float("nan"), 0.0)), 100)
    assert opponents.score("tictactoe@1") == pytest.approx((20 + PRIOR_GAMES / 2) / (20 + PRIOR_GAMES))
    opponents.add([], HALF_LIFE)
    assert opponents.score("tictactoe@1") == pytest.approx((10 + PRIOR_GAMES / 2) / (10 + PRIOR_GAMES))
    assert opponents.score("tictactoe@2") == pytest.approx(0.5)


def test_the_shares_of_opponents_that_are_no_longer_drawn_vanish(registry: Registry) -> None:
    opponents = opponents_of(registry)
    opponents.add(metrics(100.0, v1=(50.0, 20.0)), 0)
    assert opponents.shares() == {"tictactoe@1": 0.5}
    restored = opponents_of(registry)
    restored.set_state(opponents.get_state())
    restored.add(metrics(100.0, v2=(50.0, 20.0)), HALF_LIFE)
    assert restored.shares() == pytest.approx({"tictactoe@1": 25 / 150, "tictactoe@2": 50 / 150})
    for _ in range(12):
        restored.add(metrics(100.0, v2=(50.0, 20.0)), HALF_LIFE)
    assert restored.shares() == pytest.approx({"tictactoe@2": 0.5}, rel=1e-3)
    assert restored.scores().keys() == restored.get_state()["scores"].keys() == {"tictactoe@2"}
    assert restored.score("tictactoe@1") == 0.5


def test_opponents_whose_games_are_not_scored_have_shares(registry: Registry) -> None:
    opponents = opponents_of(registry)
    opponents.add(unscored(10.0, {"v1": (4.0, 0.0, 0.0), "v2": (1.0, 2.0, 2.0)}), 0)
    assert opponents.shares() == {"tictactoe@1": 0.4, "tictactoe@2": 0.1}
    assert opponents.scores().keys() == {"tictactoe@2"}


def test_the_learners_scores_become_those_of_its_checkpoint(registry: Registry) -> None:
    registries.publish(registry, "other/1")
    opponents = refreshed(registry, sampling="nash", forgotten=0, active=1)
    opponents.add(metrics(v1=(90.0, 90.0)), 0)
    opponents.refresh(checkpoint="own/1000")
    registries.publish(registry, "own/1000")
    opponents.refresh(checkpoint="own/2000")
    opponents.draw()
    assert [opponent.ref for opponent in opponents.active] == ["tictactoe@2"]
    expected = (90 + PRIOR_GAMES / 2) / (90 + PRIOR_GAMES)
    np.testing.assert_allclose(opponents.get_state()["payoff"], [[0.5, 1 - expected], [expected, 0.5]])


def test_draws_continue_from_a_saved_state(registry: Registry) -> None:
    publish(registry, 6)
    first = refreshed(registry, sampling="pfsp", active=2)
    first.add(metrics(v1=(10.0, 1.0), v2=(10.0, 9.0)), 0)
    first.refresh(checkpoint="own/1000")
    second = opponents_of(registry, sampling="pfsp", active=2)
    second.set_state(first.get_state())

    def draws(opponents: LeagueOpponents) -> Iterator[tuple[OpponentConfig, ...]]:
        opponents.reset(1000)
        for _ in range(6):
            yield opponents.active
            opponents.draw()

    drawn = list(draws(first))
    assert drawn == list(draws(second))
    assert all(len(active) <= 2 for active in drawn)
    assert len(set(drawn)) > 1


def test_removed_versions_are_not_drawn_after_resuming(registry: Registry) -> None:
    publish(registry, 3)
    opponents = refreshed(registry, sampling="uniform", window=2)
    opponents.set_state(opponents.get_state() | {"candidates": refs(9, 3)})
    opponents.drop_removed()
    opponents.draw()
    assert [opponent.ref for opponent in opponents.active] == ["tictactoe@3"]


def test_the_prior_is_the_parents_score_in_the_league(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    publish(registry, 2)
    sums = PairSums(matches=1, whole=GameSums(Counter({(30, 12, 48): 1})))
    monkeypatch.setattr(Ledger, "sums", lambda *_: {("tictactoe@1", "tictactoe@2"): sums})
    opponents = opponents_of(registry)
    opponents.refresh(parent=2)
    parents_score = (24 + PRIOR_GAMES / 2) / (30 + PRIOR_GAMES)
    assert opponents.score("tictactoe@1") == pytest.approx(parents_score)
    opponents.add(metrics(v1=(30.0, 30.0)), 0)
    expected = (30 + PRIOR_GAMES * parents_score) / (30 + PRIOR_GAMES)
    assert opponents.score("tictactoe@1") == pytest.approx(expected)
    assert opponents.score("tictactoe@2") == pytest.approx(0.5), "the parent itself"


def test_a_run_from_a_version_counts_its_own_episodes(registry: Registry) -> None:
    publish(registry, 2)
    before = refreshed(registry)
    before.add(metrics(100.0, v1=(40.0, 10.0)), 0)
    after = opponents_of(registry)
    after.set_state(before.get_state())
    assert after.shares() == {"tictactoe@1": 0.4}, "the run itself continues"
    after.refresh(parent=2)
    assert (after.shares(), after.scores()) == ({}, {})
    after.add(metrics(10.0, v2=(5.0, 5.0)), 0)
    assert after.shares() == {"tictactoe@2": 0.5}
    scores, score = after.scores(), after.score("tictactoe@1")
    assert score == pytest.approx((10 + PRIOR_GAMES / 2) / (40 + PRIOR_GAMES)), "the scores of the parent's run"
    after.refresh(checkpoint="own/1", parent=2)
    assert (after.shares(), after.scores()) == ({"tictactoe@2": 0.5}, scores)
    resumed = opponents_of(registry)
    resumed.set_state(after.get_state())
    resumed.refresh(checkpoint="own/2", parent=2)
    assert (resumed.scores(), resumed.score("tictactoe@1")) == (scores, score)


def test_the_payoff_matrix_has_matches_and_training_games() -> None:
    blocks = [Outcome(("a", "b"), 2, (2.0, 0.0), matches=5)]
    payoffs = payoff_matrix(("a", "b", "c"), blocks, {"c": {"b": (10.0, 10.0), "unknown": (5.0, 5.0)}})
    score = (10 + PRIOR_GAMES / 2) / (10 + PRIOR_GAMES)
    np.testing.assert_allclose(payoffs, [[0.5, score, 0.5], [1 - score, 0.5, 1 - score], [0.5, score, 0.5]])


@pytest.mark.parametrize("window", [1, 3])
def test_versions_published_since_the_checkpoint_replace_no_opponent_after_resuming(
    registry: Registry, window: int
) -> None:
    publish(registry, 4)
    first, second = (build(registry, sampling="uniform", window=window) for build in (refreshed, opponents_of))
    state = first.get_state()
    publish(registry, 6)
    second.set_state(state)
    second.drop_removed()
    for opponents in (first, second):
        opponents.reset(1000)
    assert second.active == first.active != ()


def test_the_latest_version_is_no_exploiter(registry: Registry) -> None:
    """In a night, the exploiter of the champion is published last."""
    publish(registry, 2)
    promote(registry, 1)
    publish_exploiter(registry, 1)
    opponents = refreshed(registry, sampling="latest")
    opponents.reset(0)
    assert opponents.candidates == refs(3, 1, 2)
    assert [opponent.ref for opponent in opponents.active] == ["tictactoe@2"]
