"""α-Rank and Nash averaging of a population of contestants, with bootstrap intervals.

`league.results.equilibria` defines both. Intervals come from a Bayesian bootstrap over matches (D. Rubin, 1981), as
for ratings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from evaluation.documents import Document, Estimate, Payoff, Population
from evaluation.statistics.payoff import Floats
from league.results.equilibria import alpha_rank, nash_averaging
from league.results.sums import Pair, PairSums, pair_of


def population(contestants: Sequence[str], sums: Mapping[Pair, PairSums], resamples: int = 200) -> Population | None:
    """α-Rank and Nash shares of `contestants`, in that order. None unless every pair has met."""
    if any(pair_of(pair) not in sums for pair in combinations(contestants, 2)):
        return None
    tables = resampled_scores(contestants, sums, resamples)
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


def shares(payoff: Payoff, sums: Mapping[Pair, PairSums]) -> tuple[PopulationShare, ...]:
    """Shares in the order of the payoff matrix. Empty if fewer than three contestants have all met each other."""
    refs = without_holes(payoff)
    if len(refs) < MIN_CONTESTANTS:
        return ()
    tables = resampled_scores(refs, sums, RESAMPLES)
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
    contestants: Sequence[str], sums: Mapping[Pair, PairSums], resamples: int = 200, seed: int = 0
) -> Floats:
    """Mean scores under random Exp(1) weights of the matches.

    Args:
        contestants: References in the order of rows and columns.
        sums: Over the matches between them; others are left out.
        resamples: Number of random weightings.
        seed: Seed of the weights.

    Returns:
        Shape (resamples + 1, n, n) with 1/2 on the diagonal. The first table has equal weights.

    Raises:
        ValueError: For two contestants that never met.
    """
    number, size = {name: i for i, name in enumerate(contestants)}, len(contestants)
    tables = np.full((resamples + 1, size, size), 0.5)
    pairs = sorted(pair for pair in sums if set(pair) <= number.keys() and pair[0] != pair[1])
    met = np.eye(size, dtype=bool)
    rng = np.random.default_rng(seed)
    for pair in pairs:
        i, j = (number[ref] for ref in pair)
        score, matches = np.array(
            sorted((points / (2 * games), k) for (games, points, _), k in sums[pair].whole.outcomes.items())
        ).T
        # Equal matches, each with an Exp(1) weight, together have a Gamma(k, 1) weight.
        weight = np.concatenate([matches[None], rng.standard_gamma(matches, (resamples, len(matches)))])
        tables[:, i, j] = (weight @ score) / weight.sum(axis=1)
        tables[:, j, i] = 1 - tables[:, i, j]
        met[[i, j], [j, i]] = True
    if not met.all():
        first, second = (contestants[i] for i in np.argwhere(~met)[0])
        raise ValueError(f"{first} and {second} never met")
    return tables


def resampled_interval(values: Floats, confidence: float = 0.95) -> tuple[Floats, Floats]:
    """Bounds (n,) of a statistic (resamples, n) that was computed under each weighting."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(values, [tail, 1 - tail], axis=0)
    return low, high
