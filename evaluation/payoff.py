"""The payoff table: who scores how much against whom, on which side, and by how much returns differ; and what follows
from the whole table for each contestant where a single number per contestant would hide cycles.

* **α-Rank** (S. Omidshafiei et al., "α-Rank: multi-agent evaluation by evolution", Scientific Reports 9, 2019): the
  share of time that a population, which imitates who scores better, spends at each contestant. Ranks cycles as one.
* **Nash averaging** (D. Balduzzi et al., "Re-evaluating evaluation", NeurIPS 2018): the equilibrium of greatest entropy
  of the game in which each picks a contestant, and each one's payoff against it. Copies of a contestant, or many weak
  ones, change nothing.

Intervals are those of a Bayesian bootstrap over matches (D. Rubin, 1981), as those of ratings are.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog, minimize
from scipy.special import logsumexp, softmax

from evaluation.paired import paired_difference
from evaluation.report import Payoff
from league.results.records import Game, Match

Floats = NDArray[np.float64]
Row = tuple[float | None, ...]


def tabulate(contestants: Sequence[str], sides: Sequence[str], matches: Iterable[Match]) -> Payoff:
    """Mean scores and games of each ordered pair of `contestants`, over all games and by the side that the row played.

    A game counts for a side where the row played that side and no other.
    `score[i][j] + score[j][i] = 1` for pairs that met, and `difference[i][j].mean = -difference[j][i].mean`.
    """
    total, by_side = _Table(contestants), {side: _Table(contestants) for side in sides}
    met: defaultdict[tuple[str, str], list[Match]] = defaultdict(list)
    for match in matches:
        for row in (0, 1):
            pair = (match.contestants[row], match.contestants[1 - row])
            met[pair].append(match)
            for game in match.games:
                score = game.scores[row]
                if score is None:
                    continue
                total.add(pair, score)
                if (side := only_side(game, row)) is not None:
                    by_side[sides[side]].add(pair, score)
    return Payoff(
        tuple(contestants),
        total.means(),
        total.counts(),
        {side: table.means() for side, table in by_side.items()},
        tuple(tuple(paired_difference(met[row, column], row) for column in contestants) for row in contestants),
    )


def only_side(game: Game, contestant: int) -> int | None:
    """The side that a contestant played in a game, None if it played several or none."""
    own = [side for side, player in enumerate(game.sides) if player == contestant]
    return own[0] if len(own) == 1 else None


def alpha_rank(scores: ArrayLike, selection: float = 100.0, population: int = 50) -> Floats:
    """The stationary distribution (..., n) over contestants of mean scores (..., n, n), `s[i, j] + s[j, i] = 1`.

    selection: how sharply better scores are preferred (the paper's α). population: how many imitate one another (m). A
    mutant r fixates among s with probability `(1 - e^-u) / (1 - e^-mu)`, `u = selection m/(m-1) (s[r, s] - 1/2)`.
    Raises ValueError for scores that are none, or that do not add up.
    """
    table = _checked(scores)
    u = selection * population / (population - 1) * (np.swapaxes(table, -1, -2) - 0.5)
    with np.errstate(over="ignore", invalid="ignore"):
        fixation = np.where(np.abs(u) < 1e-12, 1 / population, np.expm1(-u) / np.expm1(-population * u))
    # Where e^-mu overflows the limit is e^(m-1)u, which is next to nothing, yet keeps every contestant reachable.
    fixation = np.maximum(np.nan_to_num(fixation), SMALLEST)
    rates = fixation / max(1, table.shape[-1] - 1)
    flat = rates.reshape(-1, *rates.shape[-2:])
    return np.stack([_stationary(each) for each in flat]).reshape(table.shape[:-1])


def _stationary(rates: Floats) -> Floats:
    """Of the Markov chain with these rates off the diagonal: eliminate states without ever subtracting (Grassmann,
    Taksar and Heyman, 1985), which keeps the smallest probabilities exact."""
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
    """The equilibrium of greatest entropy (n,) of an antisymmetric payoff (n, n), and all payoffs (n,) against it.

    payoff: `a[i, j] = -a[j, i]`, for mean scores `2 s - 1`. Who is in the equilibrium gets 0, all others less, or 0.
    Raises ValueError unless it is antisymmetric.
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
    """Who is played in some equilibrium: an equilibrium p in which everybody either is, or loses against it.

    There is one (A. Goldman and A. Tucker, "Theory of linear programming", 1956), and who loses against it is in no
    other. It has the greatest t with `p - table @ p >= t`.
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
    """The p of greatest entropy with `inside @ p = 0` and `outside @ p <= 0`.

    Where no other p solves the equations it is that. Else p is proportional to `exp(-rows.T @ l)`, where l minimises
    the logarithm of the sum (the dual of the problem), `l >= 0` for the inequalities.
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


def resampled(contestants: Sequence[str], matches: Iterable[Match], resamples: int = 200, seed: int = 0) -> Floats:
    """Mean scores (resamples + 1, n, n) under random weights Exp(1) of the matches; the first with equal weights.

    1/2 on the diagonal. Raises ValueError for two contestants that never met.
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
            raise ValueError(f"{one} and {other} never met: the table has a hole")
        tables[row] = points / total
    return tables


def interval(values: Floats, confidence: float = 0.95) -> tuple[Floats, Floats]:
    """Bounds of a statistic (resamples, n) that was computed under each weighting."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(values, [tail, 1 - tail], axis=0)
    return low, high


def _checked(scores: ArrayLike) -> Floats:
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim < 2 or table.shape[-1] != table.shape[-2]:
        raise ValueError(f"scores are a square matrix, or several, not of shape {table.shape}")
    whole = table + np.swapaxes(table, -1, -2)
    if not np.allclose(whole, 1.0, atol=1e-6):
        raise ValueError("scores of two contestants must add up to 1, and be 1/2 on the diagonal")
    return table


SMALLEST = 1e-250
"""Rate at which a population goes over to who always loses; any that is positive."""
RANK = 1e-9
"""Singular values below this, relative to the largest, are zero."""


class _Table:
    def __init__(self, contestants: Sequence[str]) -> None:
        self._index = {name: i for i, name in enumerate(contestants)}
        shape = (len(contestants), len(contestants))
        self._points: NDArray[np.float64] = np.zeros(shape)
        self._games: NDArray[np.int64] = np.zeros(shape, dtype=np.int64)

    def add(self, pair: tuple[str, str], points: float) -> None:
        row, column = (self._index[name] for name in pair)
        self._points[row, column] += points
        self._games[row, column] += 1

    def means(self) -> tuple[Row, ...]:
        return tuple(
            tuple(float(p / n) if n else None for p, n in zip(points, games, strict=True))
            for points, games in zip(self._points, self._games, strict=True)
        )

    def counts(self) -> tuple[tuple[int, ...], ...]:
        return tuple(tuple(int(n) for n in row) for row in self._games)
