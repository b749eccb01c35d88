"""α-Rank and Nash averaging of a population of contestants, with bootstrap intervals.

* **α-Rank** (S. Omidshafiei et al., "α-Rank: multi-agent evaluation by evolution", Scientific Reports 9, 2019): the
  share of time that a population, whose members imitate better-scoring contestants, spends at each contestant. The
  members of a cycle share one rank.
* **Nash averaging** (D. Balduzzi et al., "Re-evaluating evaluation", NeurIPS 2018): the maximum-entropy equilibrium of
  the game in which both players pick a contestant, and each contestant's payoff against it. Copies of a contestant and
  additional weak contestants do not change it.

Intervals come from a Bayesian bootstrap over matches (D. Rubin, 1981), as for ratings.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog, minimize
from scipy.special import logsumexp, softmax

from evaluation.results import Document, Estimate, Payoff, Population
from evaluation.statistics.payoff import Floats
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
    taken: list[int] = []
    for i in range(len(payoff.contestants)):
        if all(payoff.games[i][j] for j in taken):
            taken.append(i)
    return [payoff.contestants[i] for i in taken]


def alpha_rank(scores: ArrayLike, selection: float = 100.0, population: int = 50) -> Floats:
    """Stationary distribution of α-Rank.

    A mutant r fixates in a population of s with probability `(1 - e^-u) / (1 - e^-mu)`, where
    `u = selection m/(m-1) (s[r, s] - 1/2)` and m is the population size.

    Args:
        scores: Mean scores with `s[i, j] + s[j, i] = 1`, shape (..., n, n).
        selection: Selection intensity, α in the paper.
        population: Population size, m in the paper.

    Returns:
        Probabilities, float64 of shape (..., n).

    Raises:
        ValueError: For scores that do not add up to 1.
    """
    table = _checked(scores)
    u = selection * population / (population - 1) * (np.swapaxes(table, -1, -2) - 0.5)
    with np.errstate(over="ignore", invalid="ignore"):
        fixation = np.where(np.abs(u) < 1e-12, 1 / population, np.expm1(-u) / np.expm1(-population * u))
    # Where e^-mu overflows, the limit e^(m-1)u is almost 0, but every contestant must stay reachable.
    fixation = np.maximum(np.nan_to_num(fixation), SMALLEST)
    rates = fixation / max(1, table.shape[-1] - 1)
    flat = rates.reshape(-1, *rates.shape[-2:])
    return np.stack([_stationary(each) for each in flat]).reshape(table.shape[:-1])


def _stationary(rates: Floats) -> Floats:
    """Stationary distribution of the Markov chain with these off-diagonal rates.

    State elimination without subtraction keeps the smallest probabilities accurate (Grassmann, Taksar and Heyman,
    1985).
    """
    chain = rates.copy()
    size = len(chain)
    for last in range(size - 1, 0, -1):
        chain[:last, last] /= chain[last, :last].sum()
        chain[:last, :last] += np.outer(chain[:last, last], chain[last, :last])
    share = np.ones(size)
    for state in range(1, size):
        share[state] = share[:state] @ chain[:state, state]
    return np.asarray(share / share.sum())


def nash_averaging(payoff: ArrayLike) -> tuple[Floats, Floats]:
    """Maximum-entropy Nash equilibrium of an antisymmetric game.

    Args:
        payoff: `a[i, j] = -a[j, i]`, shape (n, n); for mean scores use `2 s - 1`.

    Returns:
        The equilibrium (n,), and the payoffs (n,) against it: 0 within its support, at most 0 outside.

    Raises:
        ValueError: Unless the payoff is square and antisymmetric.
    """
    table = np.asarray(payoff, dtype=np.float64)
    if table.ndim != 2 or table.shape[0] != table.shape[1] or not np.allclose(table, -table.T, atol=1e-9):
        raise ValueError(f"the payoff must be a square antisymmetric matrix, not of shape {table.shape}")
    support = _support(table)
    share = np.zeros(len(table))
    others = np.setdiff1d(np.arange(len(table)), support)
    share[support] = _most_even(table[np.ix_(support, support)], table[np.ix_(others, support)])
    return share, table @ share


def _support(table: Floats) -> NDArray[np.intp]:
    """Contestants with positive probability in some equilibrium.

    There is an equilibrium p in which every contestant either is played or loses against p (A. Goldman and A. Tucker,
    "Theory of linear programming", 1956); contestants that lose against it are in no equilibrium. It maximises t
    subject to `p - table @ p >= t`.
    """
    size = len(table)
    ones, no_gain = np.ones((size, 1)), np.concatenate([table, np.zeros((size, 1))], axis=1)
    solved = linprog(
        -np.eye(size + 1)[size],
        A_ub=np.concatenate([no_gain, np.concatenate([table - np.eye(size), ones], axis=1)]),
        b_ub=np.zeros(2 * size),
        A_eq=np.append(np.ones(size), 0.0)[None],
        b_eq=[1.0],
    )
    share = np.asarray(solved.x)[:size]
    return np.flatnonzero(share > -table @ share)


def _most_even(inside: Floats, outside: Floats) -> Floats:
    """The p of maximum entropy with `inside @ p = 0` and `outside @ p <= 0`.

    If the solution of the equations is unique, that is p. Otherwise p is proportional to `exp(-rows.T @ l)`, where l
    minimises the log-sum-exp (the dual problem), with `l >= 0` for the inequalities.
    """
    _, singular, basis = np.linalg.svd(inside)
    rank = int((singular > RANK * max(1.0, singular[0])).sum())
    if rank == len(inside) - 1:
        alone = np.abs(basis[-1])
        return np.asarray(alone / alone.sum())
    rows = np.concatenate([basis[:rank], outside])
    if not len(rows):
        return np.full(len(inside), 1 / len(inside))

    def dual(multipliers: Floats) -> tuple[float, Floats]:
        logits = -rows.T @ multipliers
        return float(logsumexp(logits)), np.asarray(-rows @ softmax(logits))

    solved = minimize(
        dual,
        np.zeros(len(rows)),
        jac=True,
        bounds=[(None, None)] * rank + [(0, None)] * len(outside),
        method="L-BFGS-B",
        options={"maxiter": 2_000, "maxfun": 10_000, "ftol": 1e-15, "gtol": 1e-9},
    )
    return np.asarray(softmax(-rows.T @ solved.x))


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


def _checked(scores: ArrayLike) -> Floats:
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim < 2 or table.shape[-1] != table.shape[-2]:
        raise ValueError(f"scores must be square matrices, got shape {table.shape}")
    whole = table + np.swapaxes(table, -1, -2)
    if not np.allclose(whole, 1.0, atol=1e-6):
        raise ValueError("scores of two contestants must add up to 1, and be 1/2 on the diagonal")
    return table


SMALLEST = 1e-250
"""Transition rate towards a contestant that always loses. Any positive number keeps the chain irreducible."""


RANK = 1e-9
"""Singular values below this, relative to the largest, count as zero."""
