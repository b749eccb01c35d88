"""α-Rank and Nash averaging of a tournament, each with intervals: what a single number per contestant would hide."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evaluation.payoff import Floats, alpha_rank, interval, nash_averaging, resampled
from evaluation.report import Estimate, Population
from league.results.records import Match


def population(contestants: Sequence[str], matches: Sequence[Match], resamples: int = 200) -> Population | None:
    """The shares of `contestants`, in that order; None unless everybody has met everybody."""
    met = {frozenset(match.contestants) for match in matches}
    if any(frozenset((a, b)) not in met for a in contestants for b in contestants if a != b):
        return None
    tables = resampled(contestants, matches, resamples)
    nash = np.stack([nash_averaging(2 * table - 1)[0] for table in tables])
    return Population(alpha_rank=_estimates(alpha_rank(tables)), nash=_estimates(nash))


def _estimates(shares: Floats) -> tuple[Estimate, ...]:
    """Of shares (resamples + 1, n), the first of which are those of the games as they were played."""
    low, high = interval(shares[1:])
    return tuple(Estimate(*(float(x) for x in bounds)) for bounds in zip(shares[0], low, high, strict=True))
