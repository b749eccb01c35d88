"""Recurrent states of agents between steps, by environment and agent."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch

State = dict[str, NDArray]
"""key → (k, width)"""


class RecurrentStates:
    """The states of one recurrent policy's agents."""

    def __init__(self, initial: Mapping[str, NDArray]) -> None:
        """initial: key → (width,), the state before an episode's first step."""
        self._initial = dict(initial)
        self._kept: dict[tuple[int, int], State] = {}

    def get(self, batch: Batch) -> State:
        """Return the states before the step of a batch's rows."""
        own = [self._kept.get(place, self._initial) for place in _agents_of(batch)]
        return {key: np.stack([state[key] for state in own]) for key in self._initial}

    def update(self, batch: Batch, after: State) -> None:
        """Store the states after the step of a batch's rows."""
        for row, place in enumerate(_agents_of(batch)):
            self._kept[place] = {key: value[row] for key, value in after.items()}

    def forget(self, env: int) -> None:
        """The episode in `env` is over."""
        for place in [place for place in self._kept if place[0] == env]:
            del self._kept[place]


def _agents_of(batch: Batch) -> list[tuple[int, int]]:
    return list(zip(batch.envs, batch.agents, strict=True))
