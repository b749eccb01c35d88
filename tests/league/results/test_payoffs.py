"""The meta-strategy of a league, from its recorded games."""

import pytest

from league.errors import NotFound
from league.results.payoffs import meta_strategy
from league.results.records import Outcome


def games(first: str, second: str, score: float, count: int = 1000) -> Outcome:
    """`count` games in which `first` has this mean score."""
    return Outcome((first, second), count, (score * count, (1 - score) * count))


CYCLE = [games("r", "s", 1.0), games("s", "p", 1.0), games("p", "r", 1.0)]


@pytest.mark.parametrize("method", ["nash", "alpha_rank"])
def test_a_cycle_is_mixed_evenly(method: str) -> None:
    found = meta_strategy(("r", "p", "s"), CYCLE, method)
    assert found.refs == ("r", "p", "s")
    assert found.probabilities == pytest.approx([1 / 3] * 3)
    assert found.scores(dict.fromkeys("rps", 1 / 3)) == pytest.approx([0.5] * 3)
    assert (found.games, found.unmet) == (3000, 0)


def test_a_dominant_version_is_alone() -> None:
    found = meta_strategy(("a", "b"), [games("a", "b", 0.9)])
    assert found.probabilities == pytest.approx([1.0, 0.0])
    assert found.scores({"a": 1.0})[1] < 0.12


def test_versions_without_games_are_left_out() -> None:
    found = meta_strategy(("new", "r", "p", "s", "b"), [*CYCLE, games("b", "r", 0.0), games("new", "script:x", 1.0)])
    assert (found.refs, found.unmet) == (("r", "p", "s", "b"), 2)
    assert found.probabilities[3] == pytest.approx(0, abs=0.01)


def test_a_league_without_games_has_none() -> None:
    with pytest.raises(NotFound, match="no two of the 2 versions have played each other"):
        meta_strategy(("a", "b"), [games("a", "script:x", 1.0)])
    with pytest.raises(NotFound, match="expected at least two versions, the league has 0"):
        meta_strategy((), [])
