"""Random moves at the start of episodes, which are played but not learned from."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class RandomMover:
    """The group of agents that move at random for now; `policy` is the one that will move for them."""

    policy: str


class Openings:
    """Between none and `plies` random moves begin each episode, as many as drawn uniformly from `rng`.

    They lead to positions that self-play alone does not visit, and that matches, which have openings, do.
    """

    def __init__(self, plies: int, policies: tuple[str, ...], copies: int, rng: np.random.Generator) -> None:
        """policies: that of each agent."""
        self._plies = plies
        self._rng = rng
        self._left = [0] * copies
        self.policies = policies
        self._movers = tuple(RandomMover(policy) for policy in policies)

    def begin(self, copy: int) -> tuple[str, ...] | tuple[RandomMover, ...]:
        """The groups of the agents at the start of an episode."""
        if not self._plies:
            return self.policies
        self._left[copy] = int(self._rng.integers(self._plies + 1))
        return self._movers if self._left[copy] else self.policies

    def move(self, copies: list[int]) -> list[int]:
        """Random moves are made in `copies`; returns those whose opening is then over."""
        over = []
        for copy in copies:
            self._left[copy] -= 1
            if self._left[copy] == 0:
                over.append(copy)
        return over
