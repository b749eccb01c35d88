from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.environment_config import EnvironmentConfig
from league.environments.vector.equality import compare
from league.environments.vector.mpe.simple_adversary import SimpleAdversary
from league.environments.vector.vector_env import UnsupportedArguments
from tests.support.environments.plans import Plan, assert_equal, plans

arguments = st.fixed_dictionaries(
    {},
    optional={"N": st.integers(1, 4), "max_cycles": st.integers(1, 12), "continuous_actions": st.booleans()},
)


def config(**kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point="mpe2.simple_adversary_v3", kwargs=kwargs)


@settings(max_examples=12)
@given(plans, arguments)
def test_all_reports_equal_those_of_the_stock_environment(plan: Plan, kwargs: dict[str, Any]) -> None:
    assert_equal(config(**kwargs), SimpleAdversary(plan.num_envs, **kwargs), plan)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("kwargs", [{}, {"continuous_actions": True}], ids=str)
def test_a_million_agent_steps_equal_those_of_the_stock_environment(kwargs: dict[str, Any]) -> None:
    found = compare(config(**kwargs), SimpleAdversary(64, **kwargs), 170_000, seed=1)
    assert found.difference is None
    assert found.episodes > 6_000


def test_each_landmark_can_be_the_goal() -> None:
    """Good agents observe the goal first, then all landmarks."""
    env, copies = SimpleAdversary(100, N=3), np.arange(100)
    _, good = env.reset(copies, copies)
    observations = good.observations["observation"]
    goals, landmarks = observations[:, :2], observations[:, 2:8].reshape(-1, 3, 2)
    is_goal = (landmarks == goals[:, np.newaxis]).all(axis=2)
    assert (is_goal.sum(axis=1) == 1).all()
    assert (is_goal.sum(axis=0) > 60).all()


def test_the_rows_of_the_adversary_are_separate() -> None:
    env, copies = SimpleAdversary(3), np.arange(3)
    adversary, good = env.reset(copies, copies)
    assert adversary.agents.tolist() == [0, 0, 0]
    assert good.envs.tolist() == [0, 0, 1, 1, 2, 2]
    assert good.agents.tolist() == [1, 2, 1, 2, 1, 2]
    assert [rows.observations["observation"].shape for rows in (adversary, good)] == [(3, 8), (6, 10)]


@pytest.mark.parametrize(
    "kwargs", [{"N": 0}, {"num_agent_neighbors": 1}, {"benchmark_data": True}, {"local_ratio": 0.5}], ids=str
)
def test_other_arguments_are_left_to_the_stock_environment(kwargs: dict[str, Any]) -> None:
    with pytest.raises(UnsupportedArguments, match=next(iter(kwargs))):
        SimpleAdversary(1, **kwargs)
