"""What evaluations and nights bring, as plain data; `to_json()` gives a JSON document without NaN."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

from league.results.records import Scoring


class Document:
    """A dataclass that is a JSON document."""

    def to_json(self) -> dict[str, Any]:
        """Nested dictionaries and lists; what is undefined is None."""
        document: dict[str, Any] = _plain(asdict(self))  # type: ignore[call-overload]
        return document


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def when(moment: datetime) -> str:
    """An instant as documents have it: `2026-03-03T12:00:00Z`."""
    return moment.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


@dataclass(frozen=True, slots=True)
class Standing(Document):
    """One contestant's results. `score` is in [0, 1], `mean_return` in the environment's own unit, over the blocks of
    which no game was forfeited (None without any).

    rating: Elo above `script:random`, None if no chain of games leads there.
    interval: the rating's two-sided 95 % interval.
    distinct_games: how many different games (seed, opening and moves) are among them; None where moves were not read.
    """

    ref: str
    mean_return: float | None
    score: float
    games: int
    distinct_games: int | None
    rating: float | None
    interval: tuple[float, float] | None


@dataclass(frozen=True, slots=True)
class RatedVersion(Document):
    """A version on its way. rating, interval: as in a Standing. champion_at: each time that it became champion."""

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
    """A mean difference of returns, in the environment's own unit, with the bounds of its 95 % interval; these take two
    blocks at least.
    """

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class Payoff(Document):
    """score[i][j] is contestant i's mean score against j over games[i][j] games; None if they did not meet.

    by_side[side][i][j] is the same for the games in which i played that side alone.
    difference[i][j] is i's mean return minus j's in the games of the same blocks.
    """

    contestants: tuple[str, ...]
    score: tuple[tuple[float | None, ...], ...]
    games: tuple[tuple[int, ...], ...]
    by_side: dict[str, tuple[tuple[float | None, ...], ...]]
    difference: tuple[tuple[Difference | None, ...], ...]


@dataclass(frozen=True, slots=True)
class Estimate(Document):
    """A value with the bounds of its 95 % interval, None where that takes more games."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class Population(Document):
    """What follows from the whole payoff table, for each contestant in its order: shares that sum to 1.

    alpha_rank: of the time that a population of imitators spends at it. nash: in the most even equilibrium of picking
    a contestant to play.
    """

    alpha_rank: tuple[Estimate, ...]
    nash: tuple[Estimate, ...]


@dataclass(frozen=True, slots=True)
class CrossPlay(Document):
    """Mean returns of a team (per agent, in the environment's own unit) in which two contestants play together.

    returns[i][j]: contestant i plays one agent, which goes round the team, and j all others; on the diagonal i plays
    all of them; None if they have not. own: the mean of the diagonal. mixed: that of all the rest.
    """

    contestants: tuple[str, ...]
    returns: tuple[tuple[Estimate | None, ...], ...]
    own: Estimate | None
    mixed: Estimate | None


StoppedBy = Literal["schedule", "games", "minutes", "precision"]
"""What ended an evaluation: its schedule's end, a budget, or ratings that were precise enough."""


@dataclass(frozen=True, slots=True)
class EvaluationReport(Document):
    """A tournament: who stands where, best first, and who beats whom; or how well contestants play together.

    schedule: the id of its schedule; of an adaptive tournament, what the ids of its rounds begin with.
    kind: `round_robin`, `gauntlet`, `adaptive` or `cross_play`.
    by_side: who stands where on each side; empty where sides are alike, or there is one.
    population: of a round robin in which everybody has met everybody, else None.
    cross_play: None in a tournament; where it is given, there are neither standings nor payoffs.
    forfeits: who forfeited how many games; nobody else is named.
    """

    league: str
    schedule: str
    environment_digest: str
    games: int
    distinct_games: int
    standings: tuple[Standing, ...]
    payoff: Payoff
    scoring: Scoring
    by_side: dict[str, tuple[Standing, ...]]
    forfeits: dict[str, int] = field(default_factory=dict)
    kind: str = "round_robin"
    stopped_by: StoppedBy = "schedule"
    population: Population | None = None
    cross_play: CrossPlay | None = None


@dataclass(frozen=True, slots=True)
class AnchorReport(Document):
    """One test of non-inferiority with its evidence, as in VerdictReport.

    margin: by how much the challenger may be weaker, in the gate's unit. schedule: of the matches that count.
    outcome: `not inferior`, `inferior`, `inconclusive`, or `open` where the verdict was voided before its end.
    """

    ref: str
    margin: float
    schedule: str
    outcome: str
    llr: float
    bounds: tuple[float, float]
    blocks: int
    games: int
    distinct_games: int
    counts: tuple[int, ...]
    score: float | None
    elo: float | None
    interval: tuple[float | None, float | None] | None


@dataclass(frozen=True, slots=True)
class VerdictReport(Document):
    """One challenger's test with its evidence.

    outcome: `promote`, `reject`, `inconclusive`, or `void` where it could not be ended: `note` says why.
    llr, bounds: the log likelihood ratio at the end, and the two values at which it decides; log wealths where returns
    are tested.
    blocks, games: those that counted. distinct_games: how many different games are among them.
    counts: blocks in each cell, worst for the challenger first.
    score: the challenger's mean score. elo, interval: its strength over the opponent in logistic Elo, with its 95 %
    interval; None where a side of it is infinite.
    alpha: what this verdict spends of a year's.
    anchors: the tests of non-inferiority that were played, after the opponent was beaten.
    difference: its mean return minus the opponent's, where contestants are compared on the same side; else None.
    promoted: whether this verdict made the challenger champion.
    note: why it did not although the opponent was beaten, or why it is void.
    """

    verdict: str
    candidate: str
    opponent: str
    outcome: str
    llr: float
    bounds: tuple[float, float]
    blocks: int
    games: int
    distinct_games: int
    counts: tuple[int, ...]
    score: float | None
    elo: float | None
    interval: tuple[float | None, float | None] | None
    promoted: bool
    alpha: float
    anchors: tuple[AnchorReport, ...] = ()
    difference: Difference | None = None
    note: str | None = None


@dataclass(frozen=True, slots=True)
class Confirmation(Document):
    """How much a promotion gained, by a fresh match of fixed length: `elo` and `interval` as in VerdictReport."""

    verdict: str
    candidate: str
    opponent: str
    games: int
    score: float
    elo: float
    interval: tuple[float | None, float | None]
    difference: Difference | None


@dataclass(frozen=True, slots=True)
class NightReport(Document):
    """One night of a league: its verdicts in order, the champion before and after, and everybody's ratings.

    confirmations: of promotions whose fresh match was played this night.
    alpha_spent: by all verdicts of the last 365 days, of the gate's `alpha`.
    faults: versions that could not be judged or rated, each with the reason; they are tried again the next night.
    """

    league: str
    champion_before: str | None
    champion: str | None
    verdicts: tuple[VerdictReport, ...]
    confirmations: tuple[Confirmation, ...]
    alpha_spent: float
    faults: tuple[str, ...]
    standings: tuple[Standing, ...]
    seconds: float


@dataclass(frozen=True, slots=True)
class Progress(Document):
    """How far the games of one schedule are.

    what: a person's words for it, such as `connect_four@3 against connect_four@2`.
    played, of: matches (blocks) so far and at most.
    llr, bounds: where the sequential test stands, for verdicts.
    """

    what: str
    played: int
    of: int
    llr: float | None = None
    bounds: tuple[float, float] | None = None


Listener = Callable[[Progress | VerdictReport], None]
"""Told how far games are, and each verdict as it falls; called in the process that asked for them."""
