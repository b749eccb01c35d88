"""Spending of the α of a year: equal parts for its nightly runs, shared by the candidates of each.

docs/statistics.md explains why.
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timedelta

YEAR = timedelta(days=365)

NIGHTS = 365
"""Nightly runs per year over which α is spent."""


def alpha_per_verdict(candidates: int, alpha: float, nights: int = NIGHTS) -> float:
    """The α of each verdict of a nightly run.

    Args:
        candidates: Candidates of the nightly run.
        alpha: The α of a year.
        nights: Nightly runs of a year.

    Raises:
        ValueError: Without candidates or runs, or for an alpha outside (0, 1).
    """
    if candidates < 1 or nights < 1 or not 0 < alpha < 1:
        raise ValueError(
            f"expected candidates >= 1, nights >= 1 and 0 < alpha < 1, got {candidates}, {nights}, {alpha}"
        )
    return alpha / nights / candidates


def alpha_spent(verdicts: Iterable[tuple[datetime, float]], now: datetime) -> float:
    """The α spent in the year before `now`. verdicts: when each was opened, and its α."""
    return sum(alpha for opened_at, alpha in verdicts if now - YEAR < opened_at)


def alpha_share(candidates: int, alpha: float, nights: int, spent: float) -> float:
    """The α of each verdict of a nightly run when `spent` of the year's α is used; 0 if nothing is left."""
    return max(0.0, min(alpha_per_verdict(candidates, alpha, nights), (alpha - spent) / candidates))
