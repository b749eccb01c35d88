"""Random moves at the start of episodes, which are played but not learned from."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from training.sampling.seats import Seat


@dataclass(frozen=True, slots=True)
class RandomMover:
    """The group of agents that move at random for now; `policy` has their spaces."""

    policy: str


class Openings:
    """Between none and `plies` random steps begin each episode, as many as drawn uniformly.

    They lead to positions that self-play alone does not visit, and that matches, which have openings, do.
    """

    def __init__(self, plies: int, policies: Sequence[str], copies: int) -> None:
        """policies: that of each agent."""
        self._plies = plies
        self._left = [0] * copies
        self._waiting: list[tuple[Seat, ...]] = [()] * copies
        self._movers = tuple(RandomMover(policy) for policy in policies)

    def begin(
        self, copy: int, seats: tuple[Seat, ...], rng: np.random.Generator
    ) -> tuple[Seat, ...] | tuple[RandomMover, ...]:
        """The groups of the agents at the start of an episode in which `seats` play."""
        if not self._plies:
            return seats
        self._left[copy], self._waiting[copy] = int(rng.integers(self._plies + 1)), seats
        return self._movers if self._left[copy] else seats

    def step(self) -> Iterator[tuple[int, tuple[Seat, ...]]]:
        """All copies are about to take a step: those whose opening it ends, and who then plays."""
        for copy, left in enumerate(self._left) if self._plies else ():
            self._left[copy] = max(left - 1, 0)
            if left == 1:
                yield copy, self._waiting[copy]
