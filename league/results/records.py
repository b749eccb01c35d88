"""Records of schedules, matches and games, and their JSON documents.

A *schedule* is an ordered list of pairings of two contestants. A *match* is one block: two games with the same seed and
opening, in which the contestants swap sides. Position i of a schedule is match `"<schedule>/<i>"`.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from typing import Any, Literal

from league.conditions import ActionSelection, Conditions

Action = Any
"""An action as JSON: an integer, or a nested list of numbers. A float32 is stored as the double of equal value."""

Scoring = Literal["game", "side", "team"]
"""What a contestant is compared with: its opponent in the same `game`, the other contestant on the same `side` in the
other game of the block, or nothing if both are one `team`. See scoring.py."""

Members = tuple[int | None, ...]
"""The member that played for each contestant of a game, None for one that is no mixture; empty without mixtures."""

GAMES_PER_BLOCK = 2

_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False)

Reason = Literal["illegal_action", "not_finite", "malformed", "crashed"]
"""Why a game was forfeited: an action outside the space or its mask; an action with NaN or infinity; an output that is
not an array of the space's shape and kind; a policy that raised."""
MAX_DETAIL = 300
"""Maximum characters of the detail of a forfeit, since each forfeited game has one."""


@dataclass(frozen=True, slots=True)
class Schedule:
    """An ordered list of matches to play.

    pairings[i] are the indices into `contestants` for match i. Pairings repeat, for sequential tests of unknown length:
    match i is pairings[i % len(pairings)].
    """

    id: str
    league: str
    kind: str
    """`verdict`, `anchor`, `exploiter`, `exploitability`, `confirmation`, `gauntlet`; `round_robin`, `challenge`,
    `adaptive` or `cross_play`"""
    seed: int
    environment_digest: str
    game_digest: str
    """Digest of what decides results, see `LeagueConfig.game`."""
    sides: tuple[str, ...]
    contestants: tuple[str, ...]
    """Pinned references: `connect_four@3`, `script:random`; never an alias."""
    pairings: tuple[tuple[int, ...], ...]
    length: int
    """Maximum number of matches."""
    opening_plies: int
    """Random environment steps at the start of each game."""
    scoring: Scoring = "game"
    actions: ActionSelection = "greedy"
    """How versions select actions."""
    common_seeds: bool = False
    """Whether the matches of a round, one of each pairing, have the same seed."""

    @property
    def conditions(self) -> Conditions:
        """The conditions under which the matches are played."""
        return Conditions(self.game_digest, self.actions)

    def contestants_at(self, position: int) -> tuple[str, ...]:
        """Return the contestants of match `position`."""
        return tuple([self.contestants[index] for index in self.pairings[position % len(self.pairings)]])

    def seed_at(self, position: int) -> int:
        """Return the seed of match `position`."""
        from league.random.seeds import derive  # NumPy takes 0.1 s to import.

        return derive(self.seed, position // self._matches_per_seed)

    def seeds_at(self, positions: Sequence[int]) -> list[int]:
        """Return the seeds of some matches."""
        from league.random.seeds import derive_each  # NumPy takes 0.1 s to import.

        return derive_each(self.seed, [position // self._matches_per_seed for position in positions]).tolist()

    @property
    def _matches_per_seed(self) -> int:
        return len(self.pairings) if self.common_seeds else 1

    def seat_at(self, position: int) -> int:
        """Return the side that one contestant controls in each game of match `position`; the other has all other sides.

        It rotates with the rounds of the schedule. With two sides it is constant, because a block plays both seatings.
        """
        return position // len(self.pairings) % len(self.sides) if len(self.sides) > 2 else 0

    def seating_at(self, position: int, game: int) -> tuple[int, ...]:
        """Return the contestant of each side in a game of match `position`. Contestant g has the seat in game g."""
        seat = self.seat_at(position)
        return tuple([game if side == seat else 1 - game for side in range(len(self.sides))])

    def match_id(self, position: int) -> str:
        """Return the id of match `position`."""
        return f"{self.id}/{position}"

    def match(self, position: int, games: "Sequence[Game]", seed: int | None = None) -> "Match":
        """Return the record of match `position` with these games.

        seed: `seed_at(position)`, if it is known.
        """
        return Match(
            id=self.match_id(position),
            league=self.league,
            schedule=self.id,
            position=position,
            contestants=self.contestants_at(position),
            seed=self.seed_at(position) if seed is None else seed,
            environment_digest=self.environment_digest,
            games=tuple(games),
        )


@dataclass(frozen=True, slots=True)
class Forfeit:
    """A contestant (index) had to act as `agent` and returned no valid action.

    detail: the exception with its place, or the action and what was expected; at most MAX_DETAIL characters. It may
    differ between machines, and is no part of the result.
    """

    contestant: int
    agent: str
    reason: Reason
    detail: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class Game:
    """One game of a block.

    sides[s] is the contestant (index) that controlled side s.
    opening and actions contain every action, by step and within a step by the environment's order of agents, so that
    stepping a new environment from `seed` with them reproduces the game.
    returns[c] is the return of contestant c, the mean over the agents of a side and then over its sides; scores[c] is
    1, ½ or 0. Both are None for a contestant that did not take part: with one side, each plays a game alone. Scores are
    None if the contestants are one team.

    A forfeited game ends at the forfeit, without the actions of that step. Its returns are those collected until then:
    they are checked in a replay but not compared. forfeits: at most one per contestant, two if both had to act at the
    same step and neither did.

    members[c] is the version that played for contestant c, if that is a mixture.
    """

    sides: tuple[int, ...]
    seed: int
    opening: tuple[Action, ...]
    actions: tuple[Action, ...]
    returns: tuple[float | None, ...]
    scores: tuple[float | None, ...]
    forfeits: tuple[Forfeit, ...] = ()
    members: Members = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """How some matches of two contestants ended, the input of ratings and payoffs.

    games: the number of games of each contestant in a match. scores: sums over them. matches: number of such matches.
    """

    contestants: tuple[str, ...]
    games: int
    scores: tuple[float, ...]
    matches: int = 1


@dataclass(frozen=True, slots=True)
class BlockResult:
    """A match without its moves.

    games: the number of games of each contestant. scores and returns are sums over them.
    A block with a forfeit has no returns, because the returns of an aborted game are not comparable.
    """

    schedule: str
    position: int
    contestants: tuple[str, ...]
    games: int
    scores: tuple[float, ...]
    returns: tuple[float, ...] | None

    @property
    def outcome(self) -> Outcome:
        return Outcome(self.contestants, self.games, self.scores)


@dataclass(frozen=True, slots=True)
class LedgerEntry:
    """A match without its moves, for listings."""

    result: BlockResult
    kind: str
    """Kind of its schedule."""
    played_at: datetime
    is_purged: bool
    """Whether it is excluded from results."""
    conditions: Conditions

    @property
    def id(self) -> str:
        return f"{self.result.schedule}/{self.result.position}"


@dataclass(frozen=True, slots=True)
class Match:
    """The block of games at one position of a schedule."""

    id: str
    league: str
    schedule: str
    position: int
    contestants: tuple[str, ...]
    seed: int
    environment_digest: str
    games: tuple[Game, ...]

    def acting(self, game: int) -> tuple[str, ...]:
        """Return who played for the contestants in a game: in place of a mixture, its member."""
        members = self.games[game].members or (None,) * len(self.contestants)
        return tuple(
            ref if member is None else f"{self.league}@{member}"
            for ref, member in zip(self.contestants, members, strict=True)
        )

    def score(self, contestant: int) -> float:
        """Return the mean score of a contestant (index) over its games, in [0, 1]."""
        return _sum([game.scores[contestant] for game in self.games]) / self._games_each

    def mean_return(self, contestant: int) -> float | None:
        """Return the mean return of a contestant (index) over its games; None if a game of the block was forfeited."""
        if self._has_forfeit:
            return None
        return _sum([game.returns[contestant] for game in self.games]) / self._games_each

    def result(self) -> BlockResult:
        """Return the match without its moves."""
        contestants, games = range(len(self.contestants)), self.games
        returns = tuple([_sum([game.returns[c] for game in games]) for c in contestants])
        return BlockResult(
            schedule=self.schedule,
            position=self.position,
            contestants=self.contestants,
            games=self._games_each,
            scores=tuple([_sum([game.scores[c] for game in games]) for c in contestants]),
            returns=None if self._has_forfeit else returns,
        )

    @property
    def _games_each(self) -> int:
        """Number of games of each contestant."""
        return len([game for game in self.games if game.returns[0] is not None])

    @property
    def _has_forfeit(self) -> bool:
        return any(game.forfeits for game in self.games)


def _sum(values: Sequence[float | None]) -> float:
    """Return the sum of the numbers among `values`."""
    return sum([value for value in values if value is not None])


def dump_schedule(schedule: Schedule) -> str:
    """Return a schedule as JSON, by field names."""
    return _ENCODER.encode({name: getattr(schedule, name) for name in Schedule.__slots__})


@lru_cache(maxsize=1024)
def load_schedule(text: str) -> Schedule:
    """Return the schedule that `dump_schedule` wrote. Recent ones are kept: results read all schedules of a league."""
    fields = json.loads(text)
    fields["pairings"] = tuple(tuple(pairing) for pairing in fields["pairings"])
    return Schedule(**fields | {name: tuple(fields[name]) for name in ("sides", "contestants")})


def dump_games(games: Sequence[Game]) -> str:
    """Return a block as JSON: the common seed and opening, and [sides, actions, returns, scores] of each game, followed
    by [contestant, agent, reason, detail] of each forfeit and {"members": [version, …]} if a mixture took part."""
    first = games[0]
    return _ENCODER.encode([first.seed, first.opening, [_game(game) for game in games]])


def load_games(text: str) -> tuple[Game, ...]:
    """Return the games that `dump_games` wrote."""
    seed, opening, games = json.loads(text)
    return tuple(
        Game(
            tuple(sides),
            seed,
            tuple(opening),
            tuple(actions),
            tuple(returns),
            tuple(scores),
            tuple(Forfeit(*part) for part in parts if isinstance(part, list)),
            next((tuple(part["members"]) for part in parts if isinstance(part, dict)), ()),
        )
        for sides, actions, returns, scores, *parts in games
    )


def _game(game: Game) -> list[Any]:
    return [
        game.sides,
        game.actions,
        game.returns,
        game.scores,
        *([forfeit.contestant, forfeit.agent, forfeit.reason, forfeit.detail] for forfeit in game.forfeits),
        *([{"members": game.members}] if game.members else ()),
    ]


def dump_numbers(numbers: Sequence[float]) -> str:
    """Return a list of numbers as JSON."""
    return _ENCODER.encode(numbers)


@lru_cache(maxsize=4096)
def load_numbers(text: str) -> tuple[float, ...]:
    """Return the list that `dump_numbers` wrote. Cached, because few of these texts are different."""
    return tuple(json.loads(text))
