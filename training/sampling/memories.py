"""The recurrent state of agents between their steps, by copy and agent."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch

State = dict[str, NDArray]
"""key → (k, width)"""


class Memories:
    """Of the agents of one policy with a memory."""

    def __init__(self, initial: Mapping[str, NDArray]) -> None:
        """initial: key → (width,), the state before an episode's first step."""
        self._initial = dict(initial)
        self._kept: dict[tuple[int, int], State] = {}

    def before(self, batch: Batch) -> State:
        """The states that the rows of a batch begin from."""
        own = [self._kept.get(place, self._initial) for place in _places(batch)]
        return {key: np.stack([state[key] for state in own]) for key in self._initial}

    def keep(self, batch: Batch, after: State) -> None:
        """What the rows of a batch have become."""
        for row, place in enumerate(_places(batch)):
            self._kept[place] = {key: value[row] for key, value in after.items()}

    def forget(self, copy: int) -> None:
        """The episode in `copy` is over."""
        for place in [place for place in self._kept if place[0] == copy]:
            del self._kept[place]


def _places(batch: Batch) -> list[tuple[int, int]]:
    return list(zip(batch.copies, batch.agents, strict=True))
