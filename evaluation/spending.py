"""How much error a single verdict may spend, so that a year of nights spends no more than it was given.

Equal parts: every night of a year gets the same, and shares it among its candidates. Schedules that give early nights
more ossify: with 6α/(π²k²) the 365th night with eight candidates needs evidence that no real improvement brings. Equal
parts cost 3.7 times the games of a verdict that has all of α for itself, and cost the same on every night for ever.

By Bonferroni's inequality the chance of any false promotion in a year is at most α, whatever 365 days are looked at,
and however many nights are held in them: when a year's α is spent, there is nothing left to promote with. A verdict
that was voided has spent its part all the same: what was seen of it may have been the reason.
"""

from collections.abc import Iterable
from datetime import datetime, timedelta

YEAR = timedelta(days=365)

NIGHTS = 365
"""Nights of a year, over which α is spent."""


def spent_by(candidates: int, alpha: float, nights: int = NIGHTS) -> float:
    """The α of each verdict of a night with so many candidates. Raises ValueError for none, or α outside (0, 1)."""
    if candidates < 1 or nights < 1 or not 0 < alpha < 1:
        raise ValueError(f"expected candidates, nights and an alpha within (0, 1), not {candidates}, {nights}, {alpha}")
    return alpha / nights / candidates


def spent(verdicts: Iterable[tuple[datetime, float]], now: datetime) -> float:
    """What verdicts, given by when they were opened and their alphas, spent in the year before `now`."""
    return sum(alpha for opened_at, alpha in verdicts if now - YEAR < opened_at)


def share(candidates: int, alpha: float, nights: int, spent: float) -> float:
    """The alpha of each verdict of a night, of which a year's verdicts so far have spent some; 0 if nothing is left."""
    return max(0.0, min(spent_by(candidates, alpha, nights), (alpha - spent) / candidates))
