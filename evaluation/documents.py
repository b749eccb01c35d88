"""Results of evaluations as plain records; `to_json()` returns a JSON document without NaN."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import UTC, datetime
from functools import cache
from typing import Any, Literal

from league.conditions import ActionSelection
from league.results.records import Scoring


class Document:
    """Base of dataclasses that convert to JSON documents."""

    def to_json(self) -> dict[str, Any]:
        """Nested dictionaries and lists. Non-finite numbers become None."""
        document: dict[str, Any] = _plain(self)
        return document


@cache
def _names(record: type) -> tuple[str, ...]:
    return tuple([field.name for field in fields(record)])


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return {name: _plain(getattr(value, name)) for name in _names(type(value))}
    return value


def iso_timestamp(moment: datetime) -> str:
    """A time as in `2026-03-03T12:00:00Z`."""
    return moment.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


@dataclass(frozen=True, slots=True)
class Standing(Document):
    """Results of one contestant in a leaderboard.

    score: mean score in [0, 1]. mean_return: in the environment's unit, over blocks without forfeits (None without
    any). rating: Elo above `script:random`; None if no chain of games connects to it.
    interval: 95 % interval of the rating.
    unique_games: distinct games by seed, opening and moves; None if the moves were not read.
    """

    ref: str
    mean_return: float | None
    score: float
    games: int
    unique_games: int | None
    rating: float | None
    interval: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class RatedVersion(Document):
    """A version with its rating, interval as in a Standing. champion_at: times when it became champion."""

    ref: str
    number: int
    made_at: str
    steps: int
    parent: int | None
    rating: float | None
    interval: tuple[float, float] | None
    games: int
    champion_at: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Difference(Document):
    """Mean difference of returns in the environment's unit, with its 95 % interval. A single block has no interval."""

    mean: float
    low: float | None
    high: float | None

    @property
    def opposite(self) -> Difference:
        """That of the second's returns minus the first's."""
        return Difference(
            -self.mean, None if self.high is None else -self.high, None if self.low is None else -self.low
        )

    def __str__(self) -> str:
        """`+1.5 [0.9, 2.1]`"""
        span = "" if self.low is None or self.high is None else f" [{self.low:.4g}, {self.high:.4g}]"
        return f"{self.mean:+.4g}{span}"


@dataclass(frozen=True, slots=True)
class ExploiterScore(Document):
    """Mean score of an exploiter over its games against a version, in [0, 1], with an interval.

    gain: mean return of the exploiter minus that of the version; None without a game that ended.
    """

    ref: str
    games: int
    score: float
    low: float
    high: float
    gain: Difference | None


@dataclass(frozen=True, slots=True)
class Exploitability(Document):
    """Learned exploitability of a version. The intervals hold jointly with 95 %.

    bound: what a best response scores at least: the highest lower bound of the exploiters. exploiters: by lower bound,
    highest first.
    """

    ref: str
    bound: float
    exploiters: tuple[ExploiterScore, ...]


@dataclass(frozen=True, slots=True)
class Payoff(Document):
    """Payoff matrix.

    score[i][j]: mean score of i against j over `games[i][j]` games; None if they did not meet.
    by_side[side][i][j]: the same for games in which i played that side alone.
    difference[i][j]: mean return of i minus that of j in the games of the same blocks.
    """

    contestants: tuple[str, ...]
    score: tuple[tuple[float | None, ...], ...]
    games: tuple[tuple[int, ...], ...]
    by_side: dict[str, tuple[tuple[float | None, ...], ...]]
    difference: tuple[tuple[Difference | None, ...], ...]


@dataclass(frozen=True, slots=True)
class Estimate(Document):
    """A value with the bounds of its 95 % interval; None if there are too few games."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class Population(Document):
    """Shares of the contestants, in the order of the payoff matrix and computed from all of it; they sum to 1.

    alpha_rank: share of time in an imitating population. nash: probability in the maximum-entropy equilibrium.
    """

    alpha_rank: tuple[Estimate, ...]
    nash: tuple[Estimate, ...]


@dataclass(frozen=True, slots=True)
class CrossPlay(Document):
    """Mean returns of a team (per agent, in the environment's unit) in which two contestants play together.

    returns[i][j]: contestant i controls one agent, which rotates, and j all others; on the diagonal i controls all
    agents; None if they have not played. own: mean of the diagonal. mixed: mean of the other cells.
    """

    contestants: tuple[str, ...]
    returns: tuple[tuple[Estimate | None, ...], ...]
    own: Estimate | None
    mixed: Estimate | None


@dataclass(frozen=True, slots=True)
class Forfeits(Document):
    """The games that a contestant forfeited.

    reasons: reason → number of games. details: reason → the exception with its place, or the action, of the first
    forfeit; without reasons of which none was recorded.
    """

    games: int
    reasons: dict[str, int]
    details: dict[str, str]

    def __str__(self) -> str:
        """`12 games: 10 by an exception (the first: RuntimeError: engine ended at bot.py, line 9), 2 by …`"""
        counts = (
            f"{count} by {_BY[reason]}" + (f" (the first: {self.details[reason]})" if reason in self.details else "")
            for reason, count in self.reasons.items()
        )
        return f"{self.games} game{'' if self.games == 1 else 's'}: {', '.join(counts)}"


_BY: dict[str, str] = {
    "crashed": "an exception",
    "illegal_action": "an illegal action",
    "malformed": "an output that is no action",
    "not_finite": "an action that is not finite",
}
"""Reason of a forfeit → its cause in words."""


StoppedBy = Literal["schedule", "games", "minutes", "precision"]
"""What ended an evaluation: the end of the schedule, a budget, or sufficient precision."""


@dataclass(frozen=True, slots=True)
class EvaluationReport(Document):
    """Result of a tournament or of cross-play.

    schedule: id of the schedule; for an adaptive tournament, the common prefix of its rounds' ids.
    kind: `round_robin`, `gauntlet`, `adaptive` or `cross_play`. actions: how versions selected them.
    by_side: leaderboard of each side; empty if sides are alike or there is only one.
    population: for a round robin in which all pairs met, else None.
    cross_play: None for a tournament. With cross-play, leaderboard and payoff are empty.
    forfeits: contestant → its forfeits, if any.
    """

    league: str
    schedule: str
    environment_digest: str
    games: int
    unique_games: int
    leaderboard: tuple[Standing, ...]
    payoff: Payoff
    scoring: Scoring
    by_side: dict[str, tuple[Standing, ...]]
    actions: ActionSelection = "greedy"
    forfeits: dict[str, Forfeits] = field(default_factory=dict)
    kind: str = "round_robin"
    stopped_by: StoppedBy = "schedule"
    population: Population | None = None
    cross_play: CrossPlay | None = None


@dataclass(frozen=True, slots=True)
class Progress(Document):
    """Progress of one schedule.

    what: human-readable, such as `connect_four@3 against connect_four@2`.
    played, of: matches (blocks) so far and at most.
    moves_per_second: actions of all games since the start of the schedule in this process; None before the first match.
    llr, bounds: state of the sequential test, for verdicts.
    nodes, cpus: of the Ray cluster that play now; None if this process plays, and before the first match.
    """

    what: str
    played: int
    of: int
    moves_per_second: float | None = None
    llr: float | None = None
    bounds: tuple[float, float] | None = None
    nodes: int | None = None
    cpus: int | None = None


Listener = Callable[[Progress], None]
"""Receives progress, in the process that started the evaluation."""
