from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.environment_config import EnvironmentConfig
from league.environments.vector.equality import DifferentialTest, compare
from league.environments.vector.mpe.simple_reference import SimpleReference
from league.environments.vector.vector_env import UnsupportedArguments
from tests.support.environments.plans import Plan, assert_equal, plans

arguments = st.fixed_dictionaries(
    {},
    optional={
        "local_ratio": st.sampled_from([0, 0.25, 0.5, 0.9, 1]),
        "max_cycles": st.integers(1, 12),
        "continuous_actions": st.booleans(),
    },
)


def config(**kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point="mpe2.simple_reference_v3", kwargs=kwargs)


@settings(max_examples=12)
@given(plans, arguments)
def test_all_reports_equal_those_of_the_stock_environment(plan: Plan, kwargs: dict[str, Any]) -> None:
    assert_equal(config(**kwargs), SimpleReference(plan.num_envs, **kwargs), plan)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("kwargs", [{}, {"continuous_actions": True}], ids=str)
def test_a_million_agent_steps_equal_those_of_the_stock_environment(kwargs: dict[str, Any]) -> None:
    found = compare(config(**kwargs), SimpleReference(64, **kwargs), 250_000, seed=1)
    assert found.difference is None
    assert found.episodes > 9_000


def test_each_of_the_fifty_actions_moves_and_speaks() -> None:
    env, copies = SimpleReference(50), np.arange(50)
    env.reset(copies, copies)
    (rows,) = env.step(copies, np.column_stack([np.arange(50), np.zeros(50, dtype=np.int64)]).ravel())
    speaker, listener = rows.observations["observation"].reshape(50, 2, 21).swapaxes(0, 1)
    assert listener[:, 11:].argmax(axis=1).tolist() == [action // 5 for action in range(50)]
    assert (listener[:, 11:].sum(axis=1) == 1).all()
    directions = np.sign(speaker[:, :2]).tolist()
    assert directions == [[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]] * 10


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_continuous_messages_are_clipped(dtype: Any) -> None:
    kwargs = {"continuous_actions": True}
    test, copy = DifferentialTest(config(**kwargs), SimpleReference(1, **kwargs)), np.zeros(1, dtype=np.int64)
    test.reset(copy, copy)
    for value in (0.0, -0.0, 1.0, 1 + 1e-5, -1e-5, 0.3):
        test.step(copy, np.full((2, 15), value, dtype=dtype))
        assert test.rows[0].observations["observation"][0, 11:].tolist() == [np.float32(np.clip(value, 0, 1))] * 10
    test.close()


@pytest.mark.parametrize("kwargs", [{"local_ratio": -1}, {"benchmark_data": True}, {"N": 3}], ids=str)
def test_other_arguments_are_left_to_the_stock_environment(kwargs: dict[str, Any]) -> None:
    with pytest.raises(UnsupportedArguments, match=next(iter(kwargs))):
        SimpleReference(1, **kwargs)
