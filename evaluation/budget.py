"""When an evaluation ends before its schedule does: a budget of games or minutes, or ratings that are precise enough.

Games and precision depend on the matches alone: the end is the same for any number of workers, and for a run that was
killed in between. Ratings are looked at where the course says, and what lies behind the first look at which they are
precise enough is not counted, even if it was played. Minutes depend on the clock, and the report says so.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from evaluation.contestants import ANCHOR
from evaluation.course import Course
from evaluation.ratings import rate
from evaluation.report import StoppedBy
from league.errors import InvalidInput
from league.results.records import GAMES_PER_BLOCK, BlockResult, Match


@dataclass(frozen=True, slots=True)
class Budget:
    """games: at most. minutes: from the start; matches that are under way then are not waited for. precision: every
    contestant's 95 % rating interval is within ± this many Elo. None for without that limit.
    """

    games: int | None = None
    minutes: float | None = None
    precision: float | None = None

    def __post_init__(self) -> None:
        if self.games is not None and self.games < GAMES_PER_BLOCK:
            raise InvalidInput(f"games: at least {GAMES_PER_BLOCK}, which is one match; got {self.games}")
        for name in ("minutes", "precision"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise InvalidInput(f"{name}: more than 0, got {value:g}")

    @property
    def is_open(self) -> bool:
        """Whether it sets no limit."""
        return self.games is self.minutes is self.precision is None


UNLIMITED = Budget()

LEAST = 20
"""Matches without which nobody's interval is believed: a few that happen to end alike would give one of no width."""


class Limit:
    """A budget while a course is played."""

    def __init__(self, budget: Budget, course: Course) -> None:
        self._budget, self._course = budget, course
        self._began = time.monotonic()
        self._looks: Iterator[int] = course.looks() if budget.precision is not None else iter(())
        self._next_look = next(self._looks, None)
        self._results: list[BlockResult] = []
        self._precise_at: int | None = None

    @property
    def most(self) -> int:
        """Matches at most."""
        games = self._budget.games
        return self._course.length if games is None else min(self._course.length, games // GAMES_PER_BLOCK)

    def is_reached(self, matches: Sequence[Match]) -> bool:
        """Whether these, all so far, are enough."""
        if len(matches) >= self.most or self._is_precise(matches):
            return True
        minutes = self._budget.minutes
        return minutes is not None and time.monotonic() - self._began >= 60 * minutes

    def counted(self, matches: Sequence[Match]) -> tuple[list[Match], StoppedBy]:
        """Those that count of all that are there, and what ended them."""
        matches = list(matches[: self.most])
        if self._is_precise(matches):
            return matches[: self._precise_at], "precision"
        if len(matches) < self.most:
            return matches, "minutes"
        return matches, "schedule" if self.most == self._course.length else "games"

    def _is_precise(self, matches: Sequence[Match]) -> bool:
        """Looks at whatever is due."""
        while self._precise_at is None and self._next_look is not None and self._next_look <= len(matches):
            self._results += [match.result() for match in matches[len(self._results) : self._next_look]]
            if self._is_within(self._results):
                self._precise_at = self._next_look
            self._next_look = next(self._looks, None)
        return self._precise_at is not None

    def _is_within(self, results: Sequence[BlockResult]) -> bool:
        matches = Counter(ref for block in results for ref in block.contestants)
        if any(matches[ref] < LEAST for ref in self._course.contestants):
            return False
        precision = self._budget.precision
        assert precision is not None, "without one there are no looks"
        ratings = rate(results, ANCHOR).values()
        return all(
            rating.low is not None and rating.high is not None and rating.high - rating.low <= 2 * precision
            for rating in ratings
        )
