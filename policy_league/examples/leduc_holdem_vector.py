"""Vectorised Leduc hold'em with information states: many hands at once, equal to leduc_holdem.py."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.leduc_holdem import LeducHoldem
from league.environments.vector.vector_env import AgentRows
from league.spaces import OBSERVATION
from policy_league.examples.leduc_holdem import FIRST_PUBLIC_CARD, MOST_ACTIONS, NUM_ACTIONS, ROUNDS


class LeducWithHistoryVector(LeducHoldem):
    """Copies of Leduc hold'em that also report the actions of the hand."""

    def __init__(self, num_envs: int, **arguments: Any) -> None:
        super().__init__(num_envs, **arguments)
        self._history = np.zeros((num_envs, ROUNDS, MOST_ACTIONS, NUM_ACTIONS), np.float32)
        self._played = np.zeros((num_envs, ROUNDS), np.int64)
        self._round = np.zeros(num_envs, np.int64)

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        self._history[env_ids] = self._played[env_ids] = self._round[env_ids] = 0
        return super().reset(env_ids, seeds)

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        current = self._round[env_ids]
        self._history[env_ids, current, self._played[env_ids, current], actions] = 1
        self._played[env_ids, current] += 1
        return super().step(env_ids, actions)

    def _rows(self, env_ids: NDArray[np.int64]) -> Sequence[AgentRows]:
        (rows,) = super()._rows(env_ids)
        stock, history = rows.observations[OBSERVATION], self._history[rows.envs].reshape(len(rows.envs), -1)
        self._round[rows.envs] = stock[:, FIRST_PUBLIC_CARD : FIRST_PUBLIC_CARD + 3].any(axis=1)
        states = np.concatenate([stock, history], axis=1)
        return (replace(rows, observations={**rows.observations, OBSERVATION: states}),)
