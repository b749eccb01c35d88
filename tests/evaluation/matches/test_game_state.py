import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.matches.game_state import ActionLog, AgentStates, RunningGame, contestant_returns
from evaluation.schedules.builders import GamePlan
from league.environments.stepping import Batch

numbers = st.floats(-1e6, 1e6)


@given(st.permutations(range(4)), st.integers(1, 5), st.integers(0, 5))
def test_actions_are_recorded_by_step_and_agent_for_any_batches(order: list[int], steps: int, opening: int) -> None:
    """Two games, whose agents act in any order; the second one is recorded without its last step."""
    log = ActionLog()
    games = np.array([3, 5])
    for step in range(steps):
        for agent in order:
            actions = 100 * games + 10 * step + agent
            log.add(games, np.array([step, step]), np.array([agent, agent]), actions)
    found = log.by_game({5: steps - 1, 3: steps}, min(opening, steps - 1))
    for game, counted in ((3, steps), (5, steps - 1)):
        expected = [100 * game + 10 * step + agent for step in range(counted) for agent in range(4)]
        cut = 4 * min(opening, steps - 1)
        assert found[game] == (tuple(expected[:cut]), tuple(expected[cut:]))


def test_a_game_without_actions_is_empty() -> None:
    assert ActionLog().by_game({0: 0}, 2) == {0: ((), ())}


def test_openings_have_their_own_generators() -> None:
    game = RunningGame(GamePlan(0, 0, (0, 1), 1, ("a", "b")))
    opening = game.generator(1, in_opening=True)
    assert game.generator(1, in_opening=True) is opening
    assert game.generator(1, in_opening=False).random() != opening.random()


def batch(envs: list[int], agents: list[int]) -> Batch:
    return Batch(np.array(envs), np.array(agents), {}, np.zeros(len(envs)))


def test_missing_states_are_zero() -> None:
    states = AgentStates(num_envs=3, agents=2)
    assert states.get(batch([0, 1], [1, 1])) is None
    states.update(batch([0, 2], [1, 1]), {"state_in_0": np.array([[3.0], [5.0]])})
    found = states.get(batch([0, 1, 2], [1, 1, 1]))
    assert found is not None
    assert found["state_in_0"].tolist() == [[3.0], [0.0], [5.0]]
    states.forget(np.array([0]))
    assert states.get(batch([0, 1], [1, 1])) is None


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
