"""Exploration noise that goes on from one step to the next."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


class OrnsteinUhlenbeck:
    """A process of its own for each agent in each copy, from 0 at the start of its episode, which moves by

        x ← (1 − θ) x + σ ε,    ε ~ N(0, 1) for each element

    It adds itself to the means of an action. Uhlenbeck and Ornstein, 1930, "On the theory of the Brownian motion", as
    used by Lillicrap et al., 2016, arXiv 1509.02971, section 7, with θ = 0.15 and σ = 0.2.
    """

    def __init__(self, theta: float, copies: int, agents: int, elements: int) -> None:
        self._theta = theta
        self._state = np.zeros((copies, agents, elements), np.float32)

    def draw(
        self, copies: Sequence[int], agents: Sequence[int], dist_inputs: NDArray, rng: np.random.Generator
    ) -> NDArray:
        """Raw actions (k, m) of those agents. dist_inputs (k, 2 m): means, then the logarithms of σ."""
        means, log_deviations = np.split(dist_inputs, 2, axis=1)
        step = np.exp(log_deviations) * rng.standard_normal(means.shape, dtype=np.float32)
        moved = (1 - self._theta) * self._state[copies, agents] + step
        self._state[copies, agents] = moved
        return (means + moved).astype(np.float32)

    def forget(self, copy: int) -> None:
        """The episode in `copy` is over."""
        self._state[copy] = 0.0
