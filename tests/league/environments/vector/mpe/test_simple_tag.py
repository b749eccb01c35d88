from typing import Any

import numpy as np
import pytest

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import DifferentialTest
from league.environments.vector.mpe.simple_tag import SimpleTag, bound_penalties
from league.environments.vector.vector_env import AgentRows

STAY, LEFT, RIGHT, DOWN, UP = range(5)
CENTRAL = (85, 93, 133, 137)
"""Seeds with which a good agent starts near the centre, far from its adversary."""


def config(**kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point="mpe2.simple_tag_v3", kwargs=kwargs)


def played(seed: int, actions: list[list[int]], **kwargs: Any) -> list[list[AgentRows]]:
    """Reports of one copy for each step, which equal those of the stock environment."""
    test, copy = DifferentialTest(config(**kwargs), SimpleTag(1, **kwargs)), np.zeros(1, dtype=np.int64)
    test.reset(copy, np.array([seed]))
    reports = []
    for action in actions:
        test.step(copy, np.array(action))
        reports.append(list(test.rows))
    test.close()
    return reports


@pytest.mark.parametrize("direction", [LEFT, RIGHT, DOWN, UP])
def test_a_good_agent_that_leaves_the_arena_is_penalised(direction: int) -> None:
    moves = [[STAY, direction]] * 30
    reports = [
        report for seed in CENTRAL for report in played(seed, moves, num_adversaries=1, num_obstacles=0, max_cycles=50)
    ]
    penalties = {-good.rewards[0] for _, good in reports}
    assert any(0 < penalty <= 1 for penalty in penalties), "near the border"
    assert any(1 < penalty < 10 for penalty in penalties), "outside"
    assert 10 in penalties, "far outside"


def test_agents_do_not_exceed_their_speeds() -> None:
    reports = played(0, [[RIGHT, LEFT]] * 25, num_adversaries=1, num_obstacles=0)
    speeds = [np.abs(rows.observations["observation"][0, :2]).max() for rows in reports[-1]]
    np.testing.assert_allclose(speeds, [1.0, 1.3], rtol=1e-6)


def test_all_adversaries_are_rewarded_for_each_contact() -> None:
    """The adversaries accelerate towards the good agent, which does not move."""
    env, copies = SimpleTag(200, num_adversaries=2, num_obstacles=0), np.arange(200)
    adversaries, good = env.reset(copies, copies)
    caught = 0
    for _ in range(25):
        # Velocity, position, the other adversary, then the good agent.
        towards = adversaries.observations["observation"][:, 6:8]
        horizontal = np.abs(towards[:, 0]) > np.abs(towards[:, 1])
        moves = np.where(horizontal, np.where(towards[:, 0] > 0, RIGHT, LEFT), np.where(towards[:, 1] > 0, UP, DOWN))
        actions = np.column_stack([moves.reshape(-1, 2), np.zeros(200, dtype=np.int64)]).ravel()
        adversaries, good = env.step(copies, actions)
        first, second = adversaries.rewards.reshape(-1, 2).T
        assert (first == second).all()
        assert set(first) <= {0, 10, 20}
        assert (good.rewards <= -first).all()
        caught += int((first > 0).sum())
    assert caught > 100


def test_penalties_at_their_limits() -> None:
    distances = np.array([0.0, np.nextafter(0.9, 0), 0.9, 0.95, np.nextafter(1.0, 0), 1.0, 2.0, 2.2, 1e300])
    with np.errstate(over="ignore"):
        found = bound_penalties(distances)
    assert found[:3].tolist() == [0, 0, 0]
    assert found[3] == (0.95 - 0.9) * 10
    assert found[5] == 1
    assert found[6] == np.exp(2.0)
    assert found[7:].tolist() == [10, 10]
    assert (np.diff(found) >= 0).all()
