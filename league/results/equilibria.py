"""α-Rank and Nash averaging of a payoff matrix.

* **α-Rank** (S. Omidshafiei et al., "α-Rank: multi-agent evaluation by evolution", Scientific Reports 9, 2019): the
  share of time that a population, whose members imitate better-scoring contestants, spends at each contestant. The
  members of a cycle share one rank.
* **Nash averaging** (D. Balduzzi et al., "Re-evaluating evaluation", NeurIPS 2018): the maximum-entropy equilibrium of
  the game in which both players pick a contestant, and each contestant's payoff against it. Copies of a contestant and
  additional weak contestants do not change it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp, softmax

Floats = NDArray[np.float64]


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
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim < 2 or table.shape[-1] != table.shape[-2]:
        raise ValueError(f"scores must be square matrices, got shape {table.shape}")
    if not np.allclose(table + np.swapaxes(table, -1, -2), 1.0, atol=1e-6):
        raise ValueError("scores of two contestants must add up to 1, and be 1/2 on the diagonal")
    u = selection * population / (population - 1) * (np.swapaxes(table, -1, -2) - 0.5)
    with np.errstate(over="ignore", invalid="ignore"):
        fixation = np.where(np.abs(u) < 1e-12, 1 / population, np.expm1(-u) / np.expm1(-population * u))
    # Where e^-mu overflows, the limit e^(m-1)u is almost 0, but every contestant must stay reachable.
    fixation = np.maximum(np.nan_to_num(fixation), SMALLEST)
    rates = fixation / max(1, table.shape[-1] - 1)
    return _stationary(rates)


def _stationary(rates: Floats) -> Floats:
    """Stationary distributions (..., n) of the Markov chains with these off-diagonal rates (..., n, n).

    State elimination without subtraction keeps the smallest probabilities accurate (Grassmann, Taksar and Heyman,
    1985).
    """
    chain = rates.copy()
    size = chain.shape[-1]
    for last in range(size - 1, 0, -1):
        chain[..., :last, last] /= chain[..., last, :last].sum(axis=-1, keepdims=True)
        chain[..., :last, :last] += chain[..., :last, last, None] * chain[..., None, last, :last]
    share = np.ones(chain.shape[:-1])
    for state in range(1, size):
        share[..., state] = (share[..., :state] * chain[..., :state, state]).sum(axis=-1)
    return np.asarray(share / share.sum(axis=-1, keepdims=True))


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
    if (share := _only_equilibrium(table)) is not None:
        return share, table @ share
    support = _support(table)
    share = np.zeros(len(table))
    other_strategies = np.setdiff1d(np.arange(len(table)), support)
    share[support] = _most_even(table[np.ix_(support, support)], table[np.ix_(other_strategies, support)])
    return share, table @ share


def _support(table: Floats) -> NDArray[np.intp]:
    """Contestants with positive probability in some equilibrium.

    There is an equilibrium p in which every contestant either is played or loses against p (A. Goldman and A. Tucker,
    "Theory of linear programming", 1956); contestants that lose against it are in no equilibrium. It maximises t
    subject to `p - table @ p >= t`. A contestant that beats all others, and any p without decisive games, need no
    linear program.
    """
    size = len(table)
    best = np.flatnonzero((table < 0).sum(axis=0) == size - 1)
    if best.size or not table.any():
        return best if best.size else np.arange(size)
    from scipy.optimize import linprog  # takes 0.2 s to import

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


def _only_equilibrium(table: Floats) -> Floats | None:
    """The equilibrium (n,), if it is the only one by a margin; None if it may not be.

    The simplex method on `max sum(x)` subject to `(table + c) @ x <= 1`, c such that all payoffs are positive (R.
    Luce and H. Raiffa, "Games and decisions", 1957, appendix 5), finds an equilibrium. It is the only one if all other
    contestants lose against it, and within its support only one p satisfies `table @ p = 0`.
    """
    size = len(table)
    payoffs = table + 1 - table.min()
    tableau = np.block([[payoffs, np.eye(size), np.ones((size, 1))], [-np.ones(size), np.zeros(size + 1)]])
    basis = np.arange(size, 2 * size)
    for _ in range(PIVOTS * size):
        entering = int(tableau[-1].argmin())
        if tableau[-1, entering] > -MARGIN:
            break
        column = tableau[:-1, entering]
        ratios = np.divide(tableau[:-1, -1], column, out=np.full(size, np.inf), where=column > MARGIN)
        leaving = int(ratios.argmin())
        tableau[leaving] /= tableau[leaving, entering]
        rates = tableau[:, entering].copy()
        rates[leaving] = 0
        tableau -= np.multiply.outer(rates, tableau[leaving])
        basis[leaving] = entering
    support = np.sort(basis[(basis < size) & (tableau[:-1, -1] > MARGIN)])
    _, singular, rows = np.linalg.svd(table[np.ix_(support, support)])
    share = np.zeros(size)
    share[support] = rows[-1] * np.copysign(1.0, rows[-1, 0])
    is_only = (singular > MARGIN).sum() == len(support) - 1 and (share[support] > MARGIN).all()
    gains = np.delete(table @ share, support)
    return share / share.sum() if is_only and (gains < -MARGIN).all() else None


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

    from scipy.optimize import minimize  # takes 0.2 s to import

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


PIVOTS = 10
"""Steps of the simplex method per contestant. It takes about two per contestant of the support."""
MARGIN = 1e-7
"""Probabilities and payoffs below this may be rounding errors."""
SMALLEST = 1e-250
"""Transition rate towards a contestant that always loses. Any positive number keeps the chain irreducible."""


RANK = 1e-9
"""Singular values below this, relative to the largest, count as zero."""
