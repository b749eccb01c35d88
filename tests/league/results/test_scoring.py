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


@given(st.tuples(pairs, pairs), scorings)
def test_what_one_gains_the_other_loses(returns: tuple[Values, Values], scoring: Scoring) -> None:
    points = scores(returns, scoring)
    assert sum(points[0]) + sum(points[1]) == 2  # type: ignore[arg-type]


@given(st.tuples(pairs, pairs), scorings)
def test_contestants_that_change_places_change_scores(returns: tuple[Values, Values], scoring: Scoring) -> None:
    """Exchanged, a block's games come in the other order, each with the contestants exchanged."""
    exchanged = [tuple(reversed(game)) for game in reversed(returns)]
    expected = [tuple(reversed(game)) for game in reversed(scores(returns, scoring))]
    assert scores(exchanged, scoring) == expected
