"""Settings that change during training: linear, cosine and piecewise linear schedules."""

import math
from bisect import bisect_right
from collections.abc import Mapping
from itertools import pairwise
from operator import itemgetter
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, Discriminator, Field, Tag

from league.config.base import Part


class ScheduleProgress(NamedTuple):
    """How far training is."""

    steps: int
    """Actions of all agents, including those of parent versions."""
    budget: float
    """Fraction of the run's budget that is spent, 0 to 1."""


class AnnealingConfig(Part):
    """A schedule from `initial` to `final`."""

    schedule: Literal["linear", "cosine"] = "linear"
    """cosine: half a period, slow at both ends (Loshchilov and Hutter, 2017, arXiv 1608.03983, equation 5)."""
    initial: float = Field(ge=0)
    final: float = Field(ge=0)
    steps: int | None = Field(default=None, ge=1)
    """Number of actions of all agents, including those of parent versions; null: the budget of the run, of steps or of
    time, whichever is spent first."""

    def at(self, progress: ScheduleProgress) -> float:
        """Return the current value."""
        done = progress.budget if self.steps is None else min(progress.steps / self.steps, 1.0)
        share = (1 - math.cos(math.pi * done)) / 2 if self.schedule == "cosine" else done
        return (1 - share) * self.initial + share * self.final


Points = tuple[tuple[Annotated[int, Field(ge=0)], Annotated[float, Field(ge=0)]], ...]
"""A piecewise linear schedule: pairs of a number of actions, including those of parent versions, and a value. Constant
before the first and after the last pair."""


def _check_points(points: Points) -> Points:
    steps = [step for step, _ in points]
    if not steps or any(first >= second for first, second in pairwise(steps)):
        raise ValueError(f"expected [step, value] pairs with increasing steps, got {[list(pair) for pair in points]}")
    return points


def _schedule_form(value: Any) -> str:
    if isinstance(value, Mapping | AnnealingConfig):
        return "annealing"
    return "points" if isinstance(value, list | tuple) else "constant"


_Annealing = Annotated[AnnealingConfig, Tag("annealing")]
_Points = Annotated[Points, AfterValidator(_check_points), Tag("points")]
Scheduled = Annotated[
    _Annealing | _Points | Annotated[float, Field(ge=0), Tag("constant")], Discriminator(_schedule_form)
]
"""A number, or a schedule of it."""
ScheduledPositive = Annotated[
    _Annealing | _Points | Annotated[float, Field(gt=0), Tag("constant")], Discriminator(_schedule_form)
]


def scheduled_value(value: Scheduled, progress: ScheduleProgress) -> float:
    """Return the current value of a setting that is a number or a schedule."""
    if isinstance(value, AnnealingConfig):
        return value.at(progress)
    if not isinstance(value, tuple):
        return value
    after = bisect_right(value, progress.steps, key=itemgetter(0))
    # Before the first pair and after the last one, both are the same.
    (first, low), (second, high) = value[max(after - 1, 0)], value[min(after, len(value) - 1)]
    share = (progress.steps - first) / (second - first) if first < second else 0.0
    return (1 - share) * low + share * high
