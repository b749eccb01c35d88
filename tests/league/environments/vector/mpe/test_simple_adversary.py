from typing import Any

import numpy as np

from league.config.environment import EnvironmentConfig
from league.environments.vector.mpe.simple_adversary import SimpleAdversary


def config(**kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point="mpe2.simple_adversary_v3", kwargs=kwargs)


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
