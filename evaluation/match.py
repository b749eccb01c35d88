"""Block design: which games a match consists of.

A match is one block: as many games as there are sides, one seed, one opening, and the contestants rotating through the
sides, so that whatever a seat or an opening is worth, every contestant gets it once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from league.results.records import Schedule, rotation
from league.seeds import generator


@dataclass(frozen=True, slots=True)
class GamePlan:
    """One game to be played.

    index: its place in the block. sides[s]: who controls side s, an index into the match's contestants.
    seed: of the environment; it is the block's in every game.
    """

    position: int
    index: int
    sides: tuple[int, ...]
    seed: int
    contestants: tuple[str, ...]

    def opening(self, attempt: int) -> np.random.Generator:
        """What the opening's moves are drawn from: the same in each game of the block, another at each attempt."""
        return generator(self.seed, "opening", attempt)

    def policy(self, side: int) -> np.random.Generator:
        """What the policy that plays `side` draws from, in this game and on that side alone."""
        return generator(self.seed, "policy", self.index, side)


def plan(schedule: Schedule, position: int) -> list[GamePlan]:
    """The games of match `position` of `schedule`, in order."""
    seed = schedule.seed_at(position)
    contestants = schedule.contestants_at(position)
    sides = len(schedule.sides)
    return [GamePlan(position, index, rotation(sides, index), seed, contestants) for index in range(sides)]


def scores(returns: Sequence[float]) -> tuple[float, ...]:
    """What each contestant scores by its return: against each other one 1, ½ or 0, and the mean of these.

    Returns are the environment's; they need not sum to zero.
    """
    rivals = len(returns) - 1
    return tuple(
        sum(_point(mine, other) for j, other in enumerate(returns) if j != i) / rivals for i, mine in enumerate(returns)
    )


def _point(mine: float, other: float) -> float:
    return 1.0 if mine > other else 0.5 if mine == other else 0.0
