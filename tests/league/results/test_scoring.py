"""Scores of games, and the meta-strategy of a league from its recorded games."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.errors import NotFound
from league.results.payoffs import meta_strategy
from league.results.records import Outcome, Scoring
from league.results.scoring import Values, scores

numbers = st.integers(-3, 3).map(float)


pairs = st.tuples(numbers, numbers)


scorings: st.SearchStrategy[Scoring] = st.sampled_from(["game", "side"])


forfeit_sets = st.tuples(*[st.sets(st.sampled_from([0, 1]))] * 2)


@given(st.tuples(pairs, pairs), scorings, forfeit_sets)
def test_scores_are_zero_sum(
    returns: tuple[Values, Values], scoring: Scoring, forfeits: tuple[set[int], set[int]]
) -> None:
    points = scores(returns, scoring, forfeits)
    assert sum(points[0]) + sum(points[1]) == 2  # type: ignore[arg-type]


@given(st.tuples(pairs, pairs), scorings, forfeit_sets)
def test_exchanging_the_contestants_exchanges_the_scores(
    returns: tuple[Values, Values], scoring: Scoring, forfeits: tuple[set[int], set[int]]
) -> None:
    """When contestants are exchanged, the games of a block come in reverse order."""
    exchanged = [tuple(reversed(game)) for game in reversed(returns)]
    exchanged_forfeits = [{1 - contestant for contestant in by} for by in reversed(forfeits)]
    expected = [tuple(reversed(game)) for game in reversed(scores(returns, scoring, forfeits))]
    assert scores(exchanged, scoring, exchanged_forfeits) == expected


@given(st.tuples(pairs, pairs), scorings, forfeit_sets, st.sampled_from([0, 1]), pairs)
def test_a_forfeit_never_increases_the_score(
    returns: tuple[Values, Values], scoring: Scoring, forfeits: tuple[set[int], set[int]], by: int, collected: Values
) -> None:
    """Whatever else happened in the block, and whatever the return until then."""
    before = scores(returns, scoring, forfeits)
    after = scores([collected, returns[1]], scoring, [forfeits[0] | {by}, forfeits[1]])
    assert sum(game[by] or 0.0 for game in after) <= sum(game[by] or 0.0 for game in before)


def test_scores_follow_the_returns_and_forfeits(subtests: pytest.Subtests) -> None:
    for returns, scoring, forfeits, expected in (
        ([(1.0, -1.0), (0.0, 0.0)], "game", None, [(1.0, 0.0), (0.5, 0.5)]),
        ([(3.0, 5.0), (5.0, 3.0)], "game", None, [(0.0, 1.0), (1.0, 0.0)]),
        # Contestant 0 is the better adversary (-1 against -2), and equally good against the adversary.
        ([(-1.0, 4.0), (4.0, -2.0)], "side", None, [(1.0, 0.5), (0.5, 0.0)]),
        ([(7.0, None), (None, 6.5)], "side", None, [(1.0, None), (None, 0.0)]),
        ([(7.0, None), (None, 7.0)], "side", None, [(0.5, None), (None, 0.5)]),
        # A forfeit loses whatever the return.
        ([(9.0, -9.0), (0.0, 0.0)], "game", [{0}, set()], [(0.0, 1.0), (0.5, 0.5)]),
        ([(9.0, -9.0), (0.0, 1.0)], "game", [{0, 1}, {1}], [(0.5, 0.5), (1.0, 0.0)]),
        ([(9.0, -9.0), (9.0, -9.0)], "side", [{0}, set()], [(0.0, 1.0), (0.0, 1.0)]),
        ([(9.0, -9.0), (9.0, -9.0)], "side", [{0}, {1}], [(0.5, 0.5), (0.5, 0.5)]),
        ([(9.0, None), (None, 6.5)], "side", [{0}, set()], [(0.0, None), (None, 1.0)]),
        ([(9.0, None), (None, 6.5)], "side", [{0}, {1}], [(0.5, None), (None, 0.5)]),
    ):
        with subtests.test(returns=returns, forfeits=forfeits):
            assert scores(returns, scoring, *([] if forfeits is None else [forfeits])) == expected


def games(first: str, second: str, score: float, count: int = 1000) -> Outcome:
    """`count` games in which `first` has this mean score."""
    return Outcome((first, second), count, (score * count, (1 - score) * count))


CYCLE = [games("r", "s", 1.0), games("s", "p", 1.0), games("p", "r", 1.0)]


@pytest.mark.parametrize("method", ["nash", "alpha_rank"])
def test_a_cycle_is_mixed_evenly(method: str) -> None:
    strategy = meta_strategy(("r", "p", "s"), CYCLE, method)
    assert strategy.refs == ("r", "p", "s")
    assert strategy.probabilities == pytest.approx([1 / 3] * 3)
    assert strategy.scores(dict.fromkeys("rps", 1 / 3)) == pytest.approx([0.5] * 3)
    assert (strategy.games, strategy.unmet) == (3000, 0)


def test_a_dominant_version_is_alone() -> None:
    strategy = meta_strategy(("a", "b"), [games("a", "b", 0.9)])
    assert strategy.probabilities == pytest.approx([1.0, 0.0])
    assert strategy.scores({"a": 1.0})[1] < 0.12


def test_versions_without_games_are_left_out() -> None:
    strategy = meta_strategy(("new", "r", "p", "s", "b"), [*CYCLE, games("b", "r", 0.0), games("new", "script:x", 1.0)])
    assert (strategy.refs, strategy.unmet) == (("r", "p", "s", "b"), 2)
    assert strategy.probabilities[3] == pytest.approx(0, abs=0.01)


def test_a_league_without_games_has_none() -> None:
    with pytest.raises(NotFound, match="no two of the 2 versions have played each other"):
        meta_strategy(("a", "b"), [games("a", "script:x", 1.0)])
    with pytest.raises(NotFound, match="expected at least two versions, the league has 0"):
        meta_strategy((), [])
