import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.results.records import Scoring
from league.results.scoring import Values, scores

numbers = st.integers(-3, 3).map(float)
pairs = st.tuples(numbers, numbers)
scorings: st.SearchStrategy[Scoring] = st.sampled_from(["game", "side"])


@pytest.mark.parametrize(
    ("returns", "scoring", "expected"),
    [
        ([(1.0, -1.0), (0.0, 0.0)], "game", [(1.0, 0.0), (0.5, 0.5)]),
        ([(3.0, 5.0), (5.0, 3.0)], "game", [(0.0, 1.0), (1.0, 0.0)]),
        # Contestant 0 is the better adversary (-1 against -2), and as good as the other one at working against it.
        ([(-1.0, 4.0), (4.0, -2.0)], "side", [(1.0, 0.5), (0.5, 0.0)]),
        ([(7.0, None), (None, 6.5)], "side", [(1.0, None), (None, 0.0)]),
        ([(7.0, None), (None, 7.0)], "side", [(0.5, None), (None, 0.5)]),
    ],
)
def test_scores_go_by_returns(returns: list[Values], scoring: Scoring, expected: list[Values]) -> None:
    assert scores(returns, scoring) == expected


@pytest.mark.parametrize(
    ("returns", "scoring", "forfeits", "expected"),
    [
        ([(9.0, -9.0), (0.0, 0.0)], "game", [{0}, set()], [(0.0, 1.0), (0.5, 0.5)]),
        ([(9.0, -9.0), (0.0, 1.0)], "game", [{0, 1}, {1}], [(0.5, 0.5), (1.0, 0.0)]),
        ([(9.0, -9.0), (9.0, -9.0)], "side", [{0}, set()], [(0.0, 1.0), (0.0, 1.0)]),
        ([(9.0, -9.0), (9.0, -9.0)], "side", [{0}, {1}], [(0.5, 0.5), (0.5, 0.5)]),
        ([(9.0, None), (None, 6.5)], "side", [{0}, set()], [(0.0, None), (None, 1.0)]),
        ([(9.0, None), (None, 6.5)], "side", [{0}, {1}], [(0.5, None), (None, 0.5)]),
    ],
)
def test_who_forfeits_loses_whatever_it_got(
    returns: list[Values], scoring: Scoring, forfeits: list[set[int]], expected: list[Values]
) -> None:
    assert scores(returns, scoring, forfeits) == expected


broken = st.tuples(*[st.sets(st.sampled_from([0, 1]))] * 2)


@given(st.tuples(pairs, pairs), scorings, broken)
def test_what_one_gains_the_other_loses(
    returns: tuple[Values, Values], scoring: Scoring, forfeits: tuple[set[int], set[int]]
) -> None:
    points = scores(returns, scoring, forfeits)
    assert sum(points[0]) + sum(points[1]) == 2  # type: ignore[arg-type]


@given(st.tuples(pairs, pairs), scorings, broken)
def test_contestants_that_change_places_change_scores(
    returns: tuple[Values, Values], scoring: Scoring, forfeits: tuple[set[int], set[int]]
) -> None:
    """Exchanged, a block's games come in the other order, each with the contestants exchanged."""
    exchanged = [tuple(reversed(game)) for game in reversed(returns)]
    other = [{1 - contestant for contestant in by} for by in reversed(forfeits)]
    expected = [tuple(reversed(game)) for game in reversed(scores(returns, scoring, forfeits))]
    assert scores(exchanged, scoring, other) == expected


@given(st.tuples(pairs, pairs), scorings, broken, st.sampled_from([0, 1]), pairs)
def test_a_forfeit_gains_nothing(
    returns: tuple[Values, Values], scoring: Scoring, forfeits: tuple[set[int], set[int]], by: int, collected: Values
) -> None:
    """Whatever else happened in the block, and whatever the game had brought until then."""
    before = scores(returns, scoring, forfeits)
    after = scores([collected, returns[1]], scoring, [forfeits[0] | {by}, forfeits[1]])
    assert sum(game[by] or 0.0 for game in after) <= sum(game[by] or 0.0 for game in before)
