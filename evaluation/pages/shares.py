"""α-Rank and Nash averaging of those contestants of a payoff table who have all met one another. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.payoff import alpha_rank, interval, nash_averaging, resampled
from evaluation.report import Document, Payoff
from league.results.records import Match

FEWEST = 3
"""Of fewer contestants a rating says it all."""
RESAMPLES = 100


@dataclass(frozen=True, slots=True)
class Share(Document):
    """One contestant's shares in [0, 1], each with its 95 % interval.

    alpha_rank: of the time that an imitating population spends at it. nash: of the equilibrium of greatest entropy;
    value: its payoff in [-1, 1] against that.
    """

    ref: str
    alpha_rank: float
    alpha_rank_interval: tuple[float, float]
    nash: float
    nash_interval: tuple[float, float]
    value: float


def shares(payoff: Payoff, matches: Sequence[Match]) -> tuple[Share, ...]:
    """In the order of the table; nothing where fewer than three have all met."""
    refs = without_holes(payoff)
    if len(refs) < FEWEST:
        return ()
    tables = resampled(refs, matches, RESAMPLES)
    ranked = alpha_rank(tables)
    averaged = [nash_averaging(2 * table - 1) for table in tables]
    nash = np.stack([share for share, _ in averaged])
    rank_low, rank_high = interval(ranked[1:])
    nash_low, nash_high = interval(nash[1:])
    return tuple(
        Share(
            ref=ref,
            alpha_rank=float(ranked[0, i]),
            alpha_rank_interval=(float(rank_low[i]), float(rank_high[i])),
            nash=float(nash[0, i]),
            nash_interval=(float(nash_low[i]), float(nash_high[i])),
            value=float(averaged[0][1][i]),
        )
        for i, ref in enumerate(refs)
    )


def without_holes(payoff: Payoff) -> list[str]:
    """Each contestant in the order of the table that has met all who were taken before it."""
    taken: list[int] = []
    for i in range(len(payoff.contestants)):
        if all(payoff.games[i][j] for j in taken):
            taken.append(i)
    return [payoff.contestants[i] for i in taken]
