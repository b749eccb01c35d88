from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import compare
from league.environments.vector.rps import RockPaperScissors
from league.environments.vector.vector_env import UnsupportedArguments
from tests.support.environments.plans import Plan, assert_equal, plans

ROCK, PAPER, SCISSORS = range(3)


def config(**kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point="pettingzoo.classic.rps_v2", kwargs=kwargs)


@settings(max_examples=60)
@given(plans, st.sampled_from([3, 5, 7]), st.integers(1, 6))
def test_all_reports_equal_those_of_the_stock_environment(plan: Plan, num_actions: int, max_cycles: int) -> None:
    arguments = {"num_actions": num_actions, "max_cycles": max_cycles}
    assert_equal(config(**arguments), RockPaperScissors(plan.num_envs, **arguments), plan)


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [{}, {"num_actions": 5, "max_cycles": 4}], ids=str)
def test_many_steps_equal_those_of_the_stock_environment(arguments: dict[str, int]) -> None:
    found = compare(config(**arguments), RockPaperScissors(256, **arguments), 100_000, seed=1)
    assert found.difference is None
    assert found.episodes > 5_000


@pytest.mark.parametrize(
    ("first", "second", "reward"),
    [
        (ROCK, SCISSORS, 1),
        (PAPER, ROCK, 1),
        (SCISSORS, PAPER, 1),
        (SCISSORS, ROCK, -1),
        (ROCK, ROCK, 0),
        (PAPER, PAPER, 0),
    ],
)
def test_rules(first: int, second: int, reward: int) -> None:
    env, copy = RockPaperScissors(1), np.zeros(1, dtype=np.int64)
    env.reset(copy, copy)
    (rows,) = env.step(copy, np.array([first, second]))
    assert rows.rewards.tolist() == [reward, -reward]
    assert not np.signbit(rows.rewards[rows.rewards == 0]).any()
    assert rows.observations["observation"].tolist() == [second, first]


def test_an_episode_is_truncated_after_max_cycles() -> None:
    env, copy = RockPaperScissors(1, max_cycles=3), np.zeros(1, dtype=np.int64)
    env.reset(copy, copy)
    flags = [env.step(copy, np.array([ROCK, ROCK]))[0] for _ in range(3)]
    assert [rows.truncations.tolist() for rows in flags] == [[False, False], [False, False], [True, True]]
    assert not any(rows.terminations.any() for rows in flags)


@pytest.mark.parametrize(
    "arguments", [{"num_actions": 4}, {"num_actions": 1}, {"max_cycles": None}, {"screen_height": 100}], ids=str
)
def test_other_arguments_are_left_to_the_stock_environment(arguments: dict[str, Any]) -> None:
    with pytest.raises(UnsupportedArguments, match=next(iter(arguments))):
        RockPaperScissors(1, **arguments)
