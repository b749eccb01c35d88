"""Recurrent states of agents between steps, by environment and agent."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch, Indices

State = dict[str, NDArray]
"""key → (k, width)"""


class RecurrentStates:
    """The states of one recurrent policy's agents."""

    def __init__(self, initial: Mapping[str, NDArray], num_envs: int, agents: int) -> None:
        """initial: key → (width,), the state before an episode's first step."""
        self._initial = dict(initial)
        self._kept = {
            key: np.tile(value, (num_envs, agents, *[1] * np.ndim(value))) for key, value in self._initial.items()
        }

    def get(self, batch: Batch) -> State:
        """Return the states before the step of a batch's rows."""
        return {key: kept[batch.envs, batch.agents] for key, kept in self._kept.items()}

    def update(self, batch: Batch, after: Mapping[str, NDArray]) -> None:
        """Store the states after the step of a batch's rows."""
        for key, kept in self._kept.items():
            kept[batch.envs, batch.agents] = after[key]

    def forget(self, envs: Indices) -> None:
        """The episodes in `envs` are over."""
        for key, kept in self._kept.items():
            kept[envs] = self._initial[key]
