"""What was asked to be played and what was played, as plain data.

A *schedule* lists pairings of two contestants in order. A *match* is one block: two games from one seed and one
opening, in which the two change places. Position i of a schedule is match `"<schedule>/<i>"`, always.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from league.seeds import derive

Action = Any
"""An action as JSON: an integer, or a list (of lists) of numbers, in which a float32 is the double of its value."""

Scoring = Literal["game", "side", "team"]
"""Whom a contestant is compared with: its opponent in the same `game`, its opponent on the same `side` in the other
game of the block, or nobody, where they are one `team`. See scoring.py."""

GAMES_PER_BLOCK = 2

Reason = Literal["illegal_action", "not_finite", "malformed", "crashed"]
"""Why a game was forfeited: by an action outside the space or its mask; by one that holds NaN or an infinity; by an
answer that is no array of the space's shape and kind; by a policy that raised."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """Matches to be played, in order.

    pairings[i] are indices into `contestants`: who plays match i. A sequential test that is not bounded by a list
    repeats its pairings: match i is pairings[i % len(pairings)].
    """

    id: str
    league: str
    kind: str
    """`verdict`, `anchor`, `confirmation`, `gauntlet`; `round_robin`, `challenge`, `adaptive` or `cross_play`"""
    seed: int
    environment_digest: str
    sides: tuple[str, ...]
    contestants: tuple[str, ...]
    """Pinned references: `connect_four@3`, `script:random`; never an alias."""
    pairings: tuple[tuple[int, ...], ...]
    length: int
    """Number of matches at most."""
    opening_plies: int
    """Random steps of the environment at the start of each game."""
    scoring: Scoring = "game"

    def contestants_at(self, position: int) -> tuple[str, ...]:
        """Who plays match `position`."""
        return tuple(self.contestants[index] for index in self.pairings[position % len(self.pairings)])

    def seed_at(self, position: int) -> int:
        """The seed of match `position`."""
        return derive(self.seed, position)

    def seat_at(self, position: int) -> int:
        """The side that one contestant has to itself in each game of match `position`, and the other all others.

        It goes round with the rounds of the schedule. With two sides both games of a block have it, whichever it is.
        """
        return position // len(self.pairings) % len(self.sides) if len(self.sides) > 2 else 0

    def seating_at(self, position: int, game: int) -> tuple[int, ...]:
        """Who controls each side in a game of match `position`: contestant 0 has the seat in game 0, 1 in game 1."""
        seat = self.seat_at(position)
        return tuple(game if side == seat else 1 - game for side in range(len(self.sides)))

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
class Forfeit:
    """A contestant (an index into the match's) had to act as `agent`, and gave no action that could be played."""

    contestant: int
    agent: str
    reason: Reason


@dataclass(frozen=True, slots=True)
class Game:
    """One game of a block.

    sides[s] is the contestant (an index into the match's) that controlled side s.
    opening and actions hold every action, step by step and within a step by the agents' order in the environment, so
    that stepping a fresh environment from `seed` with them plays the same game again.
    returns[c] is contestant c's return, the mean over the agents of a side and then over its sides; scores[c] is 1, ½
    or 0. Both are None for a contestant that took no part: where there is one side, each plays a game alone. Scores are
    None where the contestants are one team.

    A game that is forfeited ends there, and none of the actions of that step is among its own. Its returns are what had
    been collected until then: they are checked when it is replayed, and compared with nothing. forfeits: by whom, at
    most one of each contestant, both where they act at once and neither can.
    """

    sides: tuple[int, ...]
    seed: int
    opening: tuple[Action, ...]
    actions: tuple[Action, ...]
    returns: tuple[float | None, ...]
    scores: tuple[float | None, ...]
    forfeits: tuple[Forfeit, ...] = ()

    def forfeited_by(self, contestant: int) -> bool:
        """Whether a contestant (by index) forfeited it."""
        return any(forfeit.contestant == contestant for forfeit in self.forfeits)


@dataclass(frozen=True, slots=True)
class BlockResult:
    """A match without its moves: what ratings and payoffs are made of.

    games: how many each contestant took part in. scores and returns are sums over those.
    A block with a forfeit has no returns: those of a game that was broken off are no measure of anybody.
    """

    schedule: str
    position: int
    contestants: tuple[str, ...]
    games: int
    scores: tuple[float, ...]
    returns: tuple[float, ...] | None


@dataclass(frozen=True, slots=True)
class Entry:
    """A match as lists of the ledger show it."""

    result: BlockResult
    kind: str
    """Of its schedule."""
    played_at: datetime
    is_purged: bool
    """Whether it counts for nothing."""

    @property
    def id(self) -> str:
        return f"{self.result.schedule}/{self.result.position}"


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
        """Mean score of a contestant (by index) over its games, in [0, 1]."""
        result = self.result()
        return result.scores[contestant] / result.games

    def mean_return(self, contestant: int) -> float | None:
        """Mean return of a contestant (by index) over its games; None if one of the block was forfeited."""
        result = self.result()
        return None if result.returns is None else result.returns[contestant] / result.games

    def result(self) -> BlockResult:
        """The match without its moves."""
        contestants = range(len(self.contestants))
        scores = [[game.scores[c] for game in self.games] for c in contestants]
        returns = [[game.returns[c] for game in self.games] for c in contestants]
        is_whole = not any(game.forfeits for game in self.games)
        return BlockResult(
            schedule=self.schedule,
            position=self.position,
            contestants=self.contestants,
            games=sum(value is not None for value in returns[0]),
            scores=tuple(sum(score for score in own if score is not None) for own in scores),
            returns=tuple(sum(value for value in own if value is not None) for own in returns) if is_whole else None,
        )
