"""α-Rank and Nash averaging of a population of contestants, with bootstrap intervals.

`league.results.equilibria` defines both. Intervals come from a Bayesian bootstrap over matches (D. Rubin, 1981), as
for ratings.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.documents import Document, Estimate, Payoff, Population
from evaluation.statistics.payoff import Floats
from league.results.equilibria import alpha_rank, nash_averaging
from league.results.records import Match


def population(contestants: Sequence[str], matches: Sequence[Match], resamples: int = 200) -> Population | None:
    """α-Rank and Nash shares of `contestants`, in that order. None unless every pair has met."""
    met = {frozenset(match.contestants) for match in matches}
    if any(frozenset((a, b)) not in met for a in contestants for b in contestants if a != b):
        return None
    tables = resampled_scores(contestants, matches, resamples)
    nash = np.stack([nash_averaging(2 * table - 1)[0] for table in tables])
    return Population(alpha_rank=_estimates(alpha_rank(tables)), nash=_estimates(nash))


def _estimates(shares: Floats) -> tuple[Estimate, ...]:
    """Estimates from shares (resamples + 1, n), whose first row has equal weights."""
    low, high = resampled_interval(shares[1:])
    return tuple(Estimate(*(float(x) for x in bounds)) for bounds in zip(shares[0], low, high, strict=True))


MIN_CONTESTANTS = 3
"""With fewer contestants, ratings contain the same information."""
RESAMPLES = 100


@dataclass(frozen=True, slots=True)
class PopulationShare(Document):
    """Shares of one contestant in [0, 1] with 95 % intervals.

    alpha_rank: share of time that an imitating population spends at it. nash: probability in the maximum-entropy
    equilibrium. value: its payoff in [-1, 1] against that equilibrium.
    """

    ref: str
    alpha_rank: float
    alpha_rank_interval: tuple[float, float]
    nash: float
    nash_interval: tuple[float, float]
    value: float


def shares(payoff: Payoff, matches: Sequence[Match]) -> tuple[PopulationShare, ...]:
    """Shares in the order of the payoff matrix. Empty if fewer than three contestants have all met each other."""
    refs = without_holes(payoff)
    if len(refs) < MIN_CONTESTANTS:
        return ()
    tables = resampled_scores(refs, matches, RESAMPLES)
    ranked = alpha_rank(tables)
    averaged = [nash_averaging(2 * table - 1) for table in tables]
    nash = np.stack([share for share, _ in averaged])
    rank_low, rank_high = resampled_interval(ranked[1:])
    nash_low, nash_high = resampled_interval(nash[1:])
    return tuple(
        PopulationShare(
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
    """Contestants in the order of the matrix, each of which has met all contestants selected before it."""
    selection: list[int] = []
    for i in range(len(payoff.contestants)):
        if all(payoff.games[i][j] for j in selection):
            selection.append(i)
    return [payoff.contestants[i] for i in selection]


def resampled_scores(
    contestants: Sequence[str], matches: Iterable[Match], resamples: int = 200, seed: int = 0
) -> Floats:
    """Mean scores under random Exp(1) weights of the matches.

    Args:
        contestants: References in the order of rows and columns.
        matches: Matches between them.
        resamples: Number of random weightings.
        seed: Seed of the weights.

    Returns:
        Shape (resamples + 1, n, n) with 1/2 on the diagonal. The first table has equal weights.

    Raises:
        ValueError: For two contestants that never met.
    """
    number = {name: i for i, name in enumerate(contestants)}
    blocks = [match for match in matches if set(match.contestants) <= number.keys()]
    first, second = (np.array([number[match.contestants[i]] for match in blocks], dtype=np.intp) for i in (0, 1))
    score = np.array([match.score(0) for match in blocks], dtype=np.float64)
    rng, size = np.random.default_rng(seed), len(contestants)
    tables = np.full((resamples + 1, size, size), 0.5)
    for row in range(resamples + 1):
        weight = rng.standard_exponential(len(blocks)) if row else np.ones(len(blocks))
        points, total = np.zeros((size, size)), np.zeros((size, size))
        np.add.at(points, (first, second), weight * score)
        np.add.at(points, (second, first), weight * (1 - score))
        for pair in ((first, second), (second, first)):
            np.add.at(total, pair, weight)
        np.fill_diagonal(points, 0.5)
        np.fill_diagonal(total, 1.0)
        if (total == 0).any():
            one, other = (contestants[i] for i in np.argwhere(total == 0)[0])
            raise ValueError(f"{one} and {other} never met")
        tables[row] = points / total
    return tables


def resampled_interval(values: Floats, confidence: float = 0.95) -> tuple[Floats, Floats]:
    """Bounds (n,) of a statistic (resamples, n) that was computed under each weighting."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(values, [tail, 1 - tail], axis=0)
    return low, high
