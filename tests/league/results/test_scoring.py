import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.results.records import Scoring
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
