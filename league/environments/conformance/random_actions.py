"""Random legal actions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.random_actions import random_actions
from league.random.seeds import derive
from league.spaces import Space
from league.spaces.arrays import environment_actions


class RandomActions:
    """Samples random legal actions that depend only on the episode's seed and the agent's turns."""

    def __init__(self, spaces: Sequence[Space]) -> None:
        self._spaces = spaces
        self._generators = [np.random.default_rng() for _ in spaces]

    def seed(self, seed: int) -> None:
        """Start an episode."""
        self._generators = [np.random.default_rng(derive(seed, agent)) for agent in range(len(self._spaces))]

    def draw(self, agent: int, mask: NDArray | None) -> Any:
        """Sample a legal action of an agent, as its environment expects it."""
        space = self._spaces[agent]
        drawn = random_actions(space, 1, None if mask is None else mask[np.newaxis], self._generators[agent])
        return environment_actions(drawn, space)[0]
