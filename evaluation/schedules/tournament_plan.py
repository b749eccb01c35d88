"""Tournament plans: the schedules that an evaluation plays one after another, and when it stops. Pure.

A round robin, a gauntlet and cross-play have one schedule. An adaptive tournament has a sequence of schedules. The next
one is a function of the matches so far, so that an interrupted evaluation resumes from the ledger. Budgets of games and
the precision of ratings depend on the matches alone, too; minutes depend on the clock. See docs/statistics.md.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from evaluation.documents import StoppedBy
from evaluation.schedules.builders import (
    ANCHOR,
    adaptive_name,
    adaptive_round,
    adaptive_rounds,
    cross_play,
    gauntlet,
    round_robin,
    too_few,
)
from evaluation.statistics.bradley_terry import rate
from league.config.league import LeagueConfig
from league.errors import InvalidInput
from league.interface import Interface
from league.results.records import GAMES_PER_BLOCK, Match, Outcome, Schedule

Kind = Literal["round_robin", "gauntlet", "adaptive", "cross_play"]

DEFAULT_BLOCKS = 32
"""Matches per pair of a round robin without a budget."""

MOST_BLOCKS = 10_000
"""Matches per pair with a budget or a target precision."""

ADAPTIVE_SHARE = 4
"""An adaptive tournament plays a quarter of the matches of a round robin: see docs/statistics.md."""

CHECK_GROWTH = 1.1
"""Growth of the number of matches between two checks of the ratings."""


@dataclass(frozen=True, slots=True)
class TournamentPlan:
    """The schedules of an evaluation.

    name: id of the schedule, or the common prefix of the ids of its rounds.
    next_schedule: the matches so far, up to the end of a schedule → the next schedule; None after the last one.
    length: maximum number of matches of all schedules.
    rounds: numbers of matches after which every contestant has had a turn, endless.
    """

    name: str
    contestants: tuple[str, ...]
    next_schedule: Callable[[Sequence[Match]], Schedule | None]
    length: int
    rounds: Callable[[], Iterator[int]]

    def precision_checks(self) -> Iterator[int]:
        """Numbers of matches at which ratings are checked: ends of rounds, at growing intervals."""
        last = 0
        for end in itertools.takewhile(lambda end: end <= self.length, self.rounds()):
            if end >= CHECK_GROWTH * last:
                yield end
                last = end


def plan_tournament(
    config: LeagueConfig,
    interface: Interface,
    kind: Kind,
    contestants: Sequence[str],
    against: Sequence[str] = (),
    blocks: int = DEFAULT_BLOCKS,
    seed: int = 0,
) -> TournamentPlan:
    """The plan of a kind of evaluation between `contestants`, which meet those of `against` in a gauntlet.

    Raises EnvironmentMismatch for contestants that cannot meet, and for cross-play without a team.
    """
    match kind:
        case "round_robin":
            return _fixed(round_robin(config, interface, contestants, blocks, seed))
        case "gauntlet":
            return _fixed(gauntlet(config, interface, contestants, against, blocks, seed, kind="challenge"))
        case "cross_play":
            return _fixed(cross_play(config, interface, contestants, blocks, seed))
        case "adaptive":
            if len(contestants) < 2:
                raise too_few(config.league, contestants)
            shortest = next(adaptive_rounds(interface, len(contestants)))
            return TournamentPlan(
                name=adaptive_name(config, interface, contestants, seed),
                contestants=tuple(contestants),
                next_schedule=lambda matches: adaptive_round(
                    config, interface, contestants, [match.result() for match in matches], seed
                ),
                length=max(shortest, math.ceil(blocks * math.comb(len(contestants), 2) / ADAPTIVE_SHARE)),
                rounds=lambda: adaptive_rounds(interface, len(contestants)),
            )


def _fixed(schedule: Schedule) -> TournamentPlan:
    turn = len(schedule.pairings)
    return TournamentPlan(
        name=schedule.id,
        contestants=schedule.contestants,
        next_schedule=lambda matches: None if matches else schedule,
        length=schedule.length,
        rounds=lambda: itertools.count(turn, turn),
    )


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of an evaluation; None for no limit.

    games: maximum number. minutes: from the start; matches in flight are discarded. precision: stop when every
    contestant's 95 % rating interval is within ± this many Elo.
    """

    games: int | None = None
    minutes: float | None = None
    precision: float | None = None

    def __post_init__(self) -> None:
        if self.games is not None and self.games < GAMES_PER_BLOCK:
            raise InvalidInput(f"games: expected at least {GAMES_PER_BLOCK} (one match), got {self.games}")
        for name in ("minutes", "precision"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise InvalidInput(f"{name}: expected more than 0, got {value:g}")

    @property
    def is_open(self) -> bool:
        """Whether it sets no limit."""
        return self.games is self.minutes is self.precision is None


UNLIMITED = Budget()

LEAST = 20
"""Minimum matches per contestant before its interval counts: from a few, it is rough."""


class StoppingRule:
    """Applies a budget to a running tournament plan."""

    def __init__(self, budget: Budget, plan: TournamentPlan) -> None:
        self._budget, self._plan = budget, plan
        self._began = time.monotonic()
        self._checks: Iterator[int] = plan.precision_checks() if budget.precision is not None else iter(())
        self._next_check = next(self._checks, None)
        self._results: list[Outcome] = []
        self._precise_at: int | None = None

    @property
    def most(self) -> int:
        """Maximum number of matches."""
        games = self._budget.games
        return self._plan.length if games is None else min(self._plan.length, games // GAMES_PER_BLOCK)

    def is_reached(self, matches: Sequence[Match]) -> bool:
        """Whether to stop after these matches, which are all so far."""
        if len(matches) >= self.most or self._is_precise(matches):
            return True
        minutes = self._budget.minutes
        return minutes is not None and time.monotonic() - self._began >= 60 * minutes

    def counted(self, matches: Sequence[Match]) -> tuple[list[Match], StoppedBy]:
        """The matches that count, and what ended the evaluation."""
        matches = list(matches[: self.most])
        if self._is_precise(matches):
            return matches[: self._precise_at], "precision"
        if len(matches) < self.most:
            return matches, "minutes"
        return matches, "schedule" if self.most == self._plan.length else "games"

    def _is_precise(self, matches: Sequence[Match]) -> bool:
        """Perform the due checks of the ratings."""
        while self._precise_at is None and self._next_check is not None and self._next_check <= len(matches):
            self._results += [match.result().outcome for match in matches[len(self._results) : self._next_check]]
            if self._is_within(self._results):
                self._precise_at = self._next_check
            self._next_check = next(self._checks, None)
        return self._precise_at is not None

    def _is_within(self, results: Sequence[Outcome]) -> bool:
        matches = Counter(ref for block in results for ref in block.contestants)
        if any(matches[ref] < LEAST for ref in self._plan.contestants):
            return False
        precision = self._budget.precision
        assert precision is not None, "ratings are checked only with a precision"
        ratings = rate(results, ANCHOR).values()
        return all(
            rating.low is not None and rating.high is not None and rating.high - rating.low <= 2 * precision
            for rating in ratings
        )
