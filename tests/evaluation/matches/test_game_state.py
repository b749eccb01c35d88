import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.matches.game_state import RunningGame, contestant_returns, stack_states
from evaluation.schedules.builders import GamePlan

numbers = st.floats(-1e6, 1e6)


@given(st.permutations(range(4)), st.integers(1, 5))
def test_actions_are_recorded_by_step_and_agent_for_any_batches(order: list[int], steps: int) -> None:
    game = RunningGame(GamePlan(0, 0, (0, 1), 1, ("a", "b")), [0.0] * 4, opening=0)
    for step in range(steps):
        for agent in order:
            game.act(agent, 10 * step + agent)
        game.end_step(0)
    assert game.actions == [10 * step + agent for step in range(steps) for agent in range(4)]
    assert game.steps == steps


def test_an_opening_ends_with_its_last_step() -> None:
    game = RunningGame(GamePlan(0, 0, (0, 1), 1, ("a", "b")), [0.0, 0.0])
    opening = game.draws(1).random()
    endings = []
    for step in range(4):
        for agent in range(2):
            game.act(agent, step)
        endings.append(game.end_step(2))
    assert endings == [False, True, False, False]
    assert game.opening == 4
    assert game.draws(1).random() != opening


def test_missing_states_are_zero() -> None:
    states = [{"state_in_0": np.array([3.0])}, None, {"state_in_0": np.array([5.0])}]
    state = stack_states(states)
    assert state is not None
    assert state["state_in_0"].tolist() == [[3.0], [0.0], [5.0]]
    assert stack_states([None, None]) is None


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
