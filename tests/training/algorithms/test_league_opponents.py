"""The candidates of a run, its scores against them, and the draws."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ray.rllib.utils.metrics import NUM_EPISODES

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


def opponents_of(registry: Registry, fixed: tuple[str, ...] = (), **league: Any) -> LeagueOpponents:
    parts = {"fixed": [{"ref": ref, "share": 0.1} for ref in fixed], "league": league}
    config = registries.config().with_training(opponents=parts)
    return LeagueOpponents(config, registries.interface(), registry.storage)


def metrics(episodes: float = 0.0, **results: tuple[float, float]) -> list[dict[str, Any]]:
    """Of one runner: its episodes, and version number → (games, score). All games are scored."""
    return unscored(episodes, {ref: (games, games, score) for ref, (games, score) in results.items()})


def unscored(total: float, results: dict[str, tuple[float, float, float]]) -> list[dict[str, Any]]:
    """Of one runner: its episodes, and version number → (episodes, scored games, score)."""
    names = ("episodes", "games", "score")
    played = {f"tictactoe@{ref[1:]}": dict(zip(names, values, strict=True)) for ref, values in results.items()}
    return [{NUM_EPISODES: total, "opponents": played}]


def publish_exploiter(registry: Registry, source: str, target: str) -> None:
    build = registries.builder()

    def build_exploiter(directory: Path, number: int) -> Manifest:
        return build(directory, number).model_copy(update={"role": EXPLOITER, "exploits": target})

    registry.publisher.publish("tictactoe", build_exploiter, source=source, parent=None)


def test_an_empty_league_has_no_opponents(registry: Registry) -> None:
    opponents = opponents_of(registry)
    opponents.refresh()
    opponents.reset(0)
    assert opponents.active == ()
    registries.publish(registry, "run/1")
    opponents.refresh()
    opponents.reset(1000)
    assert [(each.ref, each.share) for each in opponents.active] == [("tictactoe@1", 0.5)]


def test_candidates_are_the_newest_versions_and_all_champions(registry: Registry) -> None:
    for number in range(7):
        registries.publish(registry, f"run/{number}")
    for champion in (1, 2):
        registry.aliases.set("tictactoe", "champion", champion, expected=ANY, actor="me", reason="test")
    opponents = opponents_of(registry, window=2)
    opponents.refresh()
    assert opponents.candidates == tuple(f"tictactoe@{number}" for number in (1, 2, 6, 7))
    opponents = opponents_of(registry, ("tictactoe@7",), window=2, champions=False)
    opponents.refresh()
    assert opponents.candidates == ("tictactoe@6",)


def test_of_a_mixture_the_members_are_candidates(registry: Registry) -> None:
    for number in range(6):
        registries.publish(registry, f"run/{number}")
    number = registry.publisher.publish_mixture("tictactoe", {1: 0.5, 3: 0.5}).number
    registry.aliases.set("tictactoe", "champion", number, expected=ANY, actor="me", reason="test")
    opponents = opponents_of(registry, window=2)
    opponents.refresh()
    assert opponents.candidates == tuple(f"tictactoe@{number}" for number in (1, 3, 5, 6))


def test_a_search_version_is_no_candidate_but_what_it_plays_is(registry: Registry) -> None:
    for number in range(3):
        registries.publish(registry, f"run/{number}")
    number = registry.publisher.publish_search("tictactoe", 1, "puct", 8, 1.0).number
    registry.aliases.set("tictactoe", "champion", number, expected=ANY, actor="me", reason="test")
    opponents = opponents_of(registry, window=1)
    opponents.refresh()
    assert opponents.candidates == ("tictactoe@1", "tictactoe@3")


def test_the_newest_exploiters_of_champions_are_candidates(registry: Registry) -> None:
    registries.publish(registry, "run/0")
    for number, target in enumerate((1, 1, 2), 2):
        publish_exploiter(registry, f"exploiter/{number}", f"tictactoe@{target}")
    for number in (5, 6):
        registries.publish(registry, f"run/{number}")
    registry.aliases.set("tictactoe", "champion", 1, expected=ANY, actor="me", reason="test")
    opponents = opponents_of(registry, window=1, champions=False)
    opponents.refresh()
    assert opponents.candidates == ("tictactoe@3", "tictactoe@6")
    opponents = opponents_of(registry, window=3, champions=False, exploiters=False)
    opponents.refresh()
    assert opponents.candidates == ("tictactoe@1", "tictactoe@5", "tictactoe@6")


def test_versions_with_another_interface_are_no_candidates(registry: Registry) -> None:
    registries.publish(registry, "run/1")
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
    for each in (opponents, restored):
        each.add(metrics(100.0, v2=(50.0, 20.0)), HALF_LIFE)
        assert each.shares() == pytest.approx({"tictactoe@1": 25 / 150, "tictactoe@2": 50 / 150})
        for _ in range(12):
            each.add(metrics(100.0, v2=(50.0, 20.0)), HALF_LIFE)
        assert each.shares() == pytest.approx({"tictactoe@2": 0.5}, rel=1e-3)
        assert each.scores().keys() == each.get_state()["scores"].keys() == {"tictactoe@2"}
        assert each.score("tictactoe@1") == 0.5


def test_opponents_whose_games_are_not_scored_have_shares(registry: Registry) -> None:
    opponents = opponents_of(registry)
    opponents.add(unscored(10.0, {"v1": (4.0, 0.0, 0.0), "v2": (1.0, 2.0, 2.0)}), 0)
    assert opponents.shares() == {"tictactoe@1": 0.4, "tictactoe@2": 0.1}
    assert opponents.scores().keys() == {"tictactoe@2"}


def test_the_learners_scores_become_those_of_its_checkpoint(registry: Registry) -> None:
    registries.publish(registry, "other/1")
    opponents = opponents_of(registry, sampling="nash", forgotten=0, active=1)
    opponents.refresh()
    opponents.add(metrics(v1=(90.0, 90.0)), 0)
    opponents.refresh(checkpoint="own/1000")
    registries.publish(registry, "own/1000")
    opponents.refresh(checkpoint="own/2000")
    opponents.draw()
    assert [each.ref for each in opponents.active] == ["tictactoe@2"]
    expected = (90 + PRIOR_GAMES / 2) / (90 + PRIOR_GAMES)
    np.testing.assert_allclose(opponents.get_state()["payoff"], [[0.5, 1 - expected], [expected, 0.5]])


def test_draws_continue_from_a_saved_state(registry: Registry) -> None:
    for number in range(6):
        registries.publish(registry, f"run/{number}")
    first = opponents_of(registry, sampling="pfsp", active=2)
    first.refresh()
    first.add(metrics(v1=(10.0, 1.0), v2=(10.0, 9.0)), 0)
    first.refresh(checkpoint="own/1000")
    second = opponents_of(registry, sampling="pfsp", active=2)
    second.set_state(first.get_state())
    draws = []
    for opponents in (first, second):
        opponents.reset(1000)
        drawn = [opponents.active]
        for _ in range(5):
            opponents.draw()
            drawn.append(opponents.active)
        draws.append(drawn)
    assert draws[0] == draws[1]
    assert all(len(active) <= 2 for active in draws[0])
    assert len(set(draws[0])) > 1


def test_removed_versions_are_not_drawn_after_resuming(registry: Registry) -> None:
    for number in range(3):
        registries.publish(registry, f"run/{number}")
    opponents = opponents_of(registry, sampling="uniform", window=2)
    opponents.refresh()
    state = opponents.get_state() | {"candidates": ("tictactoe@9", "tictactoe@3")}
    opponents.set_state(state)
    opponents.drop_removed()
    opponents.draw()
    assert [each.ref for each in opponents.active] == ["tictactoe@3"]


def test_the_prior_is_the_parents_score_in_the_league(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(2):
        registries.publish(registry, f"run/{number}")
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
    for number in range(2):
        registries.publish(registry, f"run/{number}")
    before = opponents_of(registry)
    before.refresh()
    before.add(metrics(100.0, v1=(40.0, 10.0)), 0)
    after = opponents_of(registry)
    after.set_state(before.get_state())
    assert after.shares() == {"tictactoe@1": 0.4}, "the run itself continues"
    after.refresh(parent=2)
    assert (after.shares(), after.scores()) == ({}, {})
    after.add(metrics(10.0, v2=(5.0, 5.0)), 0)
    assert after.shares() == {"tictactoe@2": 0.5}
    found, score = after.scores(), after.score("tictactoe@1")
    assert score == pytest.approx((10 + PRIOR_GAMES / 2) / (40 + PRIOR_GAMES)), "the scores of the parent's run"
    after.refresh(checkpoint="own/1", parent=2)
    assert (after.shares(), after.scores()) == ({"tictactoe@2": 0.5}, found)
    resumed = opponents_of(registry)
    resumed.set_state(after.get_state())
    resumed.refresh(checkpoint="own/2", parent=2)
    assert (resumed.scores(), resumed.score("tictactoe@1")) == (found, score)


def test_the_payoff_matrix_has_matches_and_training_games() -> None:
    blocks = [Outcome(("a", "b"), 2, (2.0, 0.0), matches=5)]
    found = payoff_matrix(("a", "b", "c"), blocks, {"c": {"b": (10.0, 10.0), "unknown": (5.0, 5.0)}})
    score = (10 + PRIOR_GAMES / 2) / (10 + PRIOR_GAMES)
    np.testing.assert_allclose(found, [[0.5, score, 0.5], [1 - score, 0.5, 1 - score], [0.5, score, 0.5]])


@pytest.mark.parametrize("window", [1, 3])
def test_versions_published_since_the_checkpoint_replace_no_opponent_after_resuming(
    registry: Registry, window: int
) -> None:
    for number in range(4):
        registries.publish(registry, f"run/{number}")
    first, second = (opponents_of(registry, sampling="uniform", window=window) for _ in range(2))
    first.refresh()
    state = first.get_state()
    for number in range(4, 10):
        registries.publish(registry, f"run/{number}")
    second.set_state(state)
    second.drop_removed()
    for opponents in (first, second):
        opponents.reset(1000)
    assert second.active == first.active != ()


def test_the_latest_version_is_no_exploiter(registry: Registry) -> None:
    """In a night, the exploiter of the champion is published last."""
    registries.publish(registry, "run/1")
    registry.aliases.set("tictactoe", "champion", 1, expected=None, actor="me", reason="test")
    registries.publish(registry, "run/2")
    publish_exploiter(registry, "exploiter/1", "tictactoe@1")
    opponents = opponents_of(registry, sampling="latest")
    opponents.refresh()
    opponents.reset(0)
    assert opponents.candidates == ("tictactoe@3", "tictactoe@1", "tictactoe@2")
    assert [each.ref for each in opponents.active] == ["tictactoe@2"]
