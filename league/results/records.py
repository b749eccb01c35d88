"""What was asked to be played and what was played, as plain data.

A *schedule* lists pairings in order. A *match* is one block of its games, in which the contestants rotate through the
sides, from one seed and one opening. Position i of a schedule is match `"<schedule>/<i>"`, always.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from league.seeds import derive

Action = Any
"""An action as JSON: an integer, or a list of numbers."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """Matches to be played, in order.

    pairings[i] are indices into `contestants`: who plays match i. A sequential test that is not bounded by a list
    repeats its pairings: match i is pairings[i % len(pairings)].
    """

    id: str
    league: str
    kind: str
    """`verdict`, `round_robin` or `gauntlet`"""
    seed: int
    environment_digest: str
    sides: tuple[str, ...]
    contestants: tuple[str, ...]
    """Pinned references: `connect_four@3`, `script:random`; never an alias."""
    pairings: tuple[tuple[int, ...], ...]
    length: int
    """Number of matches at most."""
    opening_plies: int

    def contestants_at(self, position: int) -> tuple[str, ...]:
        """Who plays match `position`."""
        return tuple(self.contestants[index] for index in self.pairings[position % len(self.pairings)])

    def seed_at(self, position: int) -> int:
        """The seed of match `position`."""
        return derive(self.seed, position)

    def match_id(self, position: int) -> str:
        """The id of match `position`."""
        return f"{self.id}/{position}"

    def match(self, position: int, games: "Sequence[Game]") -> "Match":
        """The record of match `position`, of which these are the games."""
        return Match(
            id=self.match_id(position),
            league=self.league,
            schedule=self.id,
            position=position,
            contestants=self.contestants_at(position),
            seed=self.seed_at(position),
            environment_digest=self.environment_digest,
            games=tuple(games),
        )


@dataclass(frozen=True, slots=True)
class Game:
    """One game of a block.

    sides[s] is the contestant (an index into the match's) that controlled side s.
    opening and actions hold every action in the order in which the environment asked for them, so that stepping a
    fresh environment from `seed` with them plays the same game again.
    returns[c] is contestant c's mean return over the agents of its side; scores[c] is 1, ½ or 0.
    """

    sides: tuple[int, ...]
    seed: int
    opening: tuple[Action, ...]
    actions: tuple[Action, ...]
    returns: tuple[float, ...]
    scores: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Match:
    """One block of games between the contestants of one position of a schedule."""

    id: str
    league: str
    schedule: str
    position: int
    contestants: tuple[str, ...]
    seed: int
    environment_digest: str
    games: tuple[Game, ...]

    def score(self, contestant: int) -> float:
        """Mean score of a contestant (by index) over the block's games, in [0, 1]."""
        return sum(game.scores[contestant] for game in self.games) / len(self.games)

    def mean_return(self, contestant: int) -> float:
        """Mean return of a contestant (by index) over the block's games."""
        return sum(game.returns[contestant] for game in self.games) / len(self.games)


def rotation(sides: int, game: int) -> tuple[int, ...]:
    """Which contestant controls each side in game `game` of a block: cyclic, game 0 in the contestants' order."""
    return tuple((side - game) % sides for side in range(sides))


@dataclass(frozen=True, slots=True)
class BlockResult:
    """A match without its moves: what ratings and payoffs are made of. Values are sums over the block's games."""

    schedule: str
    position: int
    contestants: tuple[str, ...]
    games: int
    scores: tuple[float, ...]
    returns: tuple[float, ...]
