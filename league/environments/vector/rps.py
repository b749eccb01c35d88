"""Vectorised rock paper scissors, equal to pettingzoo.classic.rps_v2 with the Parallel API."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows, UnsupportedArguments, VectorEnv


class RockPaperScissors(VectorEnv):
    """Copies of rock paper scissors, or of its extension to more actions. Agents observe the opponent's last action.

    Of two actions whose difference is even, the lower one wins; if it is odd, the higher one.
    """

    possible_agents = ("player_0", "player_1")

    def __init__(self, num_envs: int, *, num_actions: int = 3, max_cycles: int = 15, **kwargs: object) -> None:
        if kwargs:
            raise UnsupportedArguments(f"rock paper scissors is not vectorised with {', '.join(kwargs)}")
        if not (isinstance(num_actions, int) and num_actions >= 3 and num_actions % 2 and isinstance(max_cycles, int)):
            raise UnsupportedArguments(f"rock paper scissors has no num_actions {num_actions}, max_cycles {max_cycles}")
        self.num_envs = num_envs
        self._num_actions, self._max_cycles = num_actions, max_cycles
        self._cycles = np.zeros(num_envs, dtype=np.int64)

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        del seeds  # nothing is random
        self._cycles[env_ids] = 0
        rows = 2 * len(env_ids)
        # Before the first action, agents observe the number of actions.
        observations = np.full(rows, self._num_actions)
        return (_rows(env_ids, observations, np.zeros(rows), np.zeros(len(env_ids), dtype=bool)),)

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[np.int64]) -> Sequence[AgentRows]:
        pairs = actions.reshape(-1, 2).astype(np.int64)
        cycles = self._cycles[env_ids] + 1
        self._cycles[env_ids] = cycles
        opponents = pairs[:, ::-1]
        higher_wins = (pairs + opponents) % 2 == 1
        wins = (pairs > opponents) == higher_wins
        rewards = np.where(pairs == opponents, 0.0, np.where(wins, 1.0, -1.0))
        return (_rows(env_ids, opponents.ravel(), rewards.ravel(), cycles >= self._max_cycles),)


def _rows(
    env_ids: NDArray[np.int64],
    observations: NDArray[np.int64],
    rewards: NDArray[np.float64],
    truncations: NDArray[np.bool_],
) -> AgentRows:
    """Two rows for each copy. truncations: of each copy, (m,)."""
    return AgentRows(
        np.repeat(env_ids, 2),
        np.tile(np.arange(2), len(env_ids)),
        {"observation": observations},
        rewards,
        np.zeros(2 * len(env_ids), dtype=bool),
        np.repeat(truncations, 2),
    )
