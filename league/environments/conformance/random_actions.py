"""Random legal actions."""

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from league.random.seeds import derive


class RandomActions:
    """Samples random legal actions that depend only on the episode's seed and the agent's turns."""

    def __init__(self, spaces: Sequence[gymnasium.Space[Any]]) -> None:
        self._spaces = [copy.deepcopy(space) for space in spaces]

    def seed(self, seed: int) -> None:
        """Start an episode."""
        for agent, space in enumerate(self._spaces):
            space.seed(derive(seed, agent) % 2**31)

    def draw(self, agent: int, mask: NDArray | None) -> Any:
        """Sample a legal action of an agent: an int, or an array in the dtype of its space."""
        space = self._spaces[agent]
        match space:
            case gymnasium.spaces.Discrete():
                return int(space.sample(mask=None if mask is None else (mask != 0).astype(np.int8)))
            case gymnasium.spaces.MultiDiscrete() if mask is not None:
                parts = np.split((mask != 0).astype(np.int8), np.cumsum(space.nvec)[:-1])
                return space.sample(mask=tuple(parts))
        return space.sample()
