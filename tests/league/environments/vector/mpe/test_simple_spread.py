from typing import Any

import numpy as np
import pytest

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import DifferentialTest
from league.environments.vector.mpe.initial_states import positions_only
from league.environments.vector.mpe.particles import lengths
from league.environments.vector.mpe.simple_spread import SIZE, SimpleSpread

STAY, LEFT, RIGHT, DOWN, UP = range(5)


def config(**kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point="mpe2.simple_spread_v3", kwargs=kwargs)


def touching_agents(agents: int) -> int:
    """A seed with which agents 0 and 1 start in contact."""
    seeds = np.arange(1000)
    positions = positions_only(seeds, 2 * agents)
    return int(seeds[lengths(positions[0] - positions[1]) < SIZE][0])


@pytest.mark.parametrize("agents", [2, 3, 4])
def test_agents_in_contact_repel_each_other(agents: int) -> None:
    test, copy = DifferentialTest(config(N=agents), SimpleSpread(1, N=agents)), np.zeros(1, dtype=np.int64)
    test.reset(copy, np.array([touching_agents(agents)]))
    for _ in range(6):
        test.step(copy, np.full(agents, STAY))
    (rows,) = test.rows
    assert np.abs(rows.observations["observation"][:2, :2]).max(axis=1).min() > 0.1, "both agents move"
    test.close()


def test_agents_that_meet_are_penalised() -> None:
    """Each of two agents accelerates towards the other."""
    env, copy = SimpleSpread(1, N=2, local_ratio=1), np.zeros(1, dtype=np.int64)
    (rows,) = env.reset(copy, np.array([touching_agents(2)]))
    rewards = []
    for _ in range(10):
        # The last two values before the messages are the relative position of the other agent.
        to_the_right = rows.observations["observation"][:, 8] > 0
        (rows,) = env.step(copy, np.where(to_the_right, RIGHT, LEFT))
        rewards += rows.rewards.tolist()
    assert set(rewards) == {0.0, -1.0}


def test_an_episode_is_truncated_after_max_cycles() -> None:
    env, copy = SimpleSpread(1, max_cycles=3), np.zeros(1, dtype=np.int64)
    env.reset(copy, copy)
    reports = [env.step(copy, np.zeros(3, dtype=np.int64))[0] for _ in range(3)]
    assert [rows.truncations.tolist() for rows in reports] == [[False] * 3, [False] * 3, [True] * 3]
    assert not any(rows.terminations.any() for rows in reports)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_continuous_actions_are_clipped(dtype: Any) -> None:
    """The league accepts actions that exceed the bounds by a relative rounding error of 1e-5."""
    kwargs = {"N": 2, "continuous_actions": True}
    test, copy = DifferentialTest(config(**kwargs), SimpleSpread(1, **kwargs)), np.zeros(1, dtype=np.int64)
    test.reset(copy, copy)
    for action in (
        [0, 0, 1, 0, 1],
        [0, 1, 0, 1, 0],
        [0, -1e-5, 1 + 1e-5, 0.3, 0.7],
        [1, 1, 1, 1, 1],
        [0, -0.0, 0, 0, -0.0],
    ):
        test.step(copy, np.array([action, action[::-1]], dtype=dtype))
    test.close()


def test_default_values_of_other_arguments_are_accepted() -> None:
    assert SimpleSpread(1, curriculum=False, num_agent_neighbors=None).possible_agents == (
        "agent_0",
        "agent_1",
        "agent_2",
    )
