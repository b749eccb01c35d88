"""Block design: which games a match consists of.

A match is one block: two games, one seed, one opening, two contestants. In the first game contestant 0 has one side,
the *seat*, to itself and contestant 1 all others; in the second they change places. So whatever a seat or an opening
is worth, both get it once:

| sides | the two games of a block                                                                           |
|-------|----------------------------------------------------------------------------------------------------|
| two   | A against B, and B against A                                                                       |
| more  | A among Bs, and B among As in the same seat; the seat goes round with the rounds of the schedule    |
| one   | A alone, and B alone: a team, or a single agent                                                    |

What the games score is said in league/results/scoring.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from league.results.records import GAMES_PER_BLOCK, Schedule
from league.seeds import generator


@dataclass(frozen=True, slots=True)
class GamePlan:
    """One game to be played.

    index: its place in the block. sides[s]: who controls side s, an index into the match's contestants.
    seed: of the environment; it is the block's in both games.
    """

    position: int
    index: int
    sides: tuple[int, ...]
    seed: int
    contestants: tuple[str, ...]

    def opening(self, attempt: int, agent: int) -> np.random.Generator:
        """What an agent's moves of the opening are drawn from: the same in both games, others at each attempt."""
        return generator(self.seed, "opening", attempt, agent)

    def policy(self, agent: int) -> np.random.Generator:
        """What the policy that plays an agent draws from, in this game and for that agent alone."""
        return generator(self.seed, "policy", self.index, agent)


def plan(schedule: Schedule, position: int) -> list[GamePlan]:
    """The games of match `position` of `schedule`, in order."""
    seed, contestants = schedule.seed_at(position), schedule.contestants_at(position)
    return [
        GamePlan(position, index, schedule.seating_at(position, index), seed, contestants)
        for index in range(GAMES_PER_BLOCK)
    ]
