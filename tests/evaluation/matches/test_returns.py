import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.matches.seating import contestant_returns, returns_of_games

numbers = st.floats(-1e6, 1e6)


@pytest.mark.parametrize(
    ("side_of", "sides", "expected"),
    [
        ([0, 1, 2], (0, 1, 1), (1.0, 6.0)),
        ([0, 1, 2], (1, 0, 1), (2.0, 5.5)),
        ([0, 0, 1], (1, 0), (10.0, 1.5)),
        ([0, 0, 0], (1,), (None, 13 / 3)),
        # Sides have the same weight, whatever their number of agents.
        ([0, 1, 1, 2], (0, 1, 1), (1.0, 6.5)),
    ],
)
def test_returns_are_means_over_agents_and_then_sides(
    side_of: list[int], sides: tuple[int, ...], expected: tuple[float | None, ...]
) -> None:
    returns = [1.0, 2.0, 10.0, 7.0][: len(side_of)]
    assert contestant_returns(returns, side_of, sides) == expected


@given(numbers, st.integers(1, 7), st.integers(2, 7))
def test_equal_returns_are_exactly_equal(value: float, agents: int, sides: int) -> None:
    """Equal returns are a draw, so that rounding must not make a mean of many differ from a mean of one."""
    side_of = [side for side in range(sides) for _ in range(agents)]
    assert contestant_returns([value] * len(side_of), side_of, (0, *[1] * (sides - 1))) == (value, value)


@pytest.mark.parametrize("side_of", [[0, 1], [1, 0], [0, 0], [0, 1, 2], [1, 0, 1]])
@given(st.data())
def test_many_games_have_the_returns_of_each(side_of: list[int], data: st.DataObject) -> None:
    sides = max(side_of) + 1
    seatings = [[int(side == seat) for side in range(sides)] for seat in range(sides)]
    games = data.draw(
        st.lists(st.tuples(st.sampled_from(seatings), st.lists(numbers, min_size=3, max_size=3)), max_size=5)
    )
    returns = np.array([own[: len(side_of)] for _, own in games]).reshape(-1, len(side_of))
    seats = np.array([seating for seating, _ in games], dtype=np.int64).reshape(-1, sides)
    expected = [contestant_returns(own[: len(side_of)], side_of, seating) for seating, own in games]
    assert repr(returns_of_games(returns, side_of, seats)) == repr(expected)
