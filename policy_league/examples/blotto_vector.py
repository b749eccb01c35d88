"""Vectorised Colonel Blotto: many games at once, equal to blotto.py."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows, VectorEnv
from policy_league.examples.blotto import AGENTS, PAYOFF


class BlottoVector(VectorEnv):
    """Copies of Colonel Blotto. They have no state: a game is a single step."""

    possible_agents = AGENTS

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        del seeds  # nothing is random
        return (_rows(env_ids, np.zeros(2 * len(env_ids)), has_ended=False),)

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[np.int64]) -> Sequence[AgentRows]:
        pairs = actions.reshape(-1, 2)
        rewards = PAYOFF[pairs, pairs[:, ::-1]]
        return (_rows(env_ids, rewards.ravel(), has_ended=True),)


def _rows(env_ids: NDArray[np.int64], rewards: NDArray[np.float64], *, has_ended: bool) -> AgentRows:
    """Two rows for each copy."""
    rows = len(rewards)
    return AgentRows(
        np.repeat(env_ids, 2),
        np.tile(np.arange(2), len(env_ids)),
        {"observation": np.zeros((rows, 1), np.float32)},
        rewards,
        np.full(rows, has_ended),
        np.zeros(rows, dtype=bool),
    )
