from typing import Any

import numpy as np
import pytest

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import DifferentialTest
from league.environments.vector.mpe.simple_reference import SimpleReference


def config(**kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point="mpe2.simple_reference_v3", kwargs=kwargs)


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
