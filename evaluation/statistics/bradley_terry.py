"""Bradley–Terry ratings of all contestants from the blocks they played, with intervals.

Contestant `i` scores against `j` with expectation `1 / (1 + 10^((r_j - r_i)/400))`; a draw counts as half a win for
each. Ratings maximise the likelihood of all games plus a prior of **one virtual draw per pair that has played**. The
rating of the anchor is 0 by definition. Intervals come from the Bayesian bootstrap over blocks and virtual draws, or,
for very large tables, from the asymptotically equivalent sandwich estimator.

Sources: R. A. Bradley and M. E. Terry, "Rank analysis of incomplete block designs" (1952); D. R. Hunter, "MM
algorithms for generalized Bradley–Terry models" (2004) for existence and connectedness; D. B. Rubin, "The
Bayesian bootstrap" (1981); M. A. Newton and A. E. Raftery, "Approximate Bayesian inference with the weighted
likelihood bootstrap" (1994); H. White, "Maximum likelihood estimation of misspecified models" (1982).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components
from scipy.special import expit, ndtri

from evaluation.statistics.blas import single_threaded_blas
from league.results.records import BlockResult

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ELO = 400 / math.log(10)
"""Elo per unit of log odds."""

TOLERANCE = 1e-3 / ELO
"""A fit has converged when no rating moves by more than a thousandth of an Elo."""

MOST_CELLS = 75_000_000
"""Random numbers beyond which intervals come from the asymptotic distribution."""

LONG = 0.5
"""Log odds. Longer steps of Newton's method may overshoot."""

PRECISE = 0.02
"""Residual of a Newton step. Steps repeat until they are short, so this does not limit the precision."""

MOST_DIRECTIONS = 100
"""Conjugate gradient iterations per step. An inexact step still increases the likelihood."""

TINY = 1e-300
"""Smaller than any relevant curvature."""

CELLS_AT_ONCE = 1_000_000
"""Random numbers per chunk of resamples, which bounds memory and fits into caches."""


@dataclass(frozen=True, slots=True)
class Rating:
    """Elo above the anchor with the bounds of its interval; all None without a chain of games to the anchor."""

    elo: float | None
    low: float | None
    high: float | None


def rate(
    results: Iterable[BlockResult],
    anchor: str,
    *,
    resamples: int = 1000,
    confidence: float = 0.95,
    seed: int = 0,
) -> dict[str, Rating]:
    """Rate all contestants in `results`. The result does not depend on the order of the blocks.

    Args:
        results: Blocks of two contestants each.
        anchor: Reference of the contestant whose rating is 0.
        resamples: Resamples of the bootstrap.
        confidence: Coverage of the intervals.
        seed: Seed of the bootstrap.

    Returns:
        Reference → rating in Elo, including the anchor.
    """
    blocks = list(results)
    names = sorted({anchor}.union(*(block.contestants for block in blocks)))
    number = {name: i for i, name in enumerate(names)}
    table = _BlockTable.of(blocks, number)
    first, second = table.pairs.T
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(names), len(names)))
    components = connected_components(graph, directed=False)[1]
    rated = np.asarray(components == components[number[anchor]])
    index = np.cumsum(rated) - 1
    table = table.only(rated[table.pairs[:, 0]], index)
    ratings = dict.fromkeys(names, Rating(None, None, None)) | {anchor: Rating(0.0, 0.0, 0.0)}
    size, base = int(rated.sum()), int(index[number[anchor]])
    if size > 1:
        with single_threaded_blas():
            fitted, low, high = _fitted(table, size, base, resamples, (1 - confidence) / 2, seed)
        for name in itertools.compress(names, rated):
            ratings[name] = Rating(*(float(ELO * x[index[number[name]]]) for x in (fitted, low, high)))
    return ratings


def _fitted(
    table: _BlockTable, size: int, base: int, resamples: int, tail: float, seed: int
) -> tuple[Floats, Floats, Floats]:
    """Log odds (size,) and the bounds of their intervals."""
    fitted = bradley_terry(*table.sums(), table.pairs, size, base)[0]
    if resamples * len(table.number) > MOST_CELLS:
        half = float(ndtri(1 - tail)) * table.deviation(fitted, base)
        return fitted, fitted - half, fitted + half
    low, high = np.quantile(table.resampled(fitted, base, resamples, seed), (tail, 1 - tail), axis=0)
    return fitted, low, high


@dataclass(frozen=True, slots=True)
class _BlockTable:
    """Blocks counted by (pair, score, games). Row `k` stands for `number[k]` equal blocks of pair `pair[k]`."""

    pairs: Ints  # (p, 2), first < second
    pair: Ints  # (k,)
    score: Floats  # (k,) of the first of the pair
    games: Floats  # (k,)
    number: Floats  # (k,)

    @classmethod
    def of(cls, blocks: Sequence[BlockResult], number: Mapping[str, int]) -> _BlockTable:
        players = np.array([[number[name] for name in block.contestants] for block in blocks], dtype=np.int64)
        players = players.reshape(-1, 2)
        games = np.array([block.games for block in blocks], dtype=np.float64)
        score = np.array([block.scores[0] for block in blocks], dtype=np.float64) / games
        swapped = players[:, 0] > players[:, 1]
        rows = np.column_stack([np.sort(players, axis=1), np.where(swapped, 1 - score, score), games])
        rows = rows[players[:, 0] != players[:, 1]]
        cells, count = np.unique(rows, axis=0, return_counts=True)
        pairs, pair = np.unique(cells[:, :2].astype(np.int64), axis=0, return_inverse=True)
        return cls(pairs, pair.reshape(-1), cells[:, 2], cells[:, 3], count.astype(np.float64))

    def only(self, kept: NDArray[np.bool_], index: Ints) -> _BlockTable:
        """The pairs `kept`, with contestants renumbered by `index`."""
        rows = kept[self.pair]
        renumbered = (np.cumsum(kept) - 1)[self.pair[rows]]
        return _BlockTable(index[self.pairs[kept]], renumbered, self.score[rows], self.games[rows], self.number[rows])

    def sums(self, weight: Floats | None = None, prior: Floats | None = None) -> tuple[Floats, Floats]:
        """Points of the first of each pair, and games, each (resamples, p), including the prior."""
        weight = self.number[None] if weight is None else weight
        prior = np.ones((1, len(self.pairs))) if prior is None else prior
        starts = np.flatnonzero(np.diff(self.pair, prepend=-1))
        games = np.add.reduceat(weight * self.games, starts, axis=1) + prior
        points = np.add.reduceat(weight * (self.games * self.score), starts, axis=1) + prior / 2
        return points, games

    def resampled(self, fitted: Floats, anchor: int, resamples: int, seed: int) -> Floats:
        """Log odds (resamples, size) refitted under random weights, starting at `fitted` (size,).

        `k` blocks of one kind together have a Gamma(k, 1) weight.
        """
        rng = np.random.default_rng(seed)
        chunk = max(1, min(resamples, CELLS_AT_ONCE // len(self.number)))
        model = _Model(self.pairs, len(fitted), anchor, near=fitted, games=self.sums()[1])
        refitted = []
        for start in range(0, resamples, chunk):
            rows = min(chunk, resamples - start)
            weight = rng.standard_gamma(self.number, size=(rows, len(self.number)))
            prior = rng.standard_exponential(size=(rows, len(self.pairs)))
            refitted.append(model.fit(*self.sums(weight, prior)))
        return np.concatenate(refitted)

    def deviation(self, fitted: Floats, anchor: int) -> Floats:
        """Asymptotic standard deviation (size,) of the log odds under random weights.

        The sandwich `H^-1 J H^-1` of the Hessian H and the sum J of squared gradients of blocks and virtual draws.
        """
        p = expit(fitted[self.pairs[:, 0]] - fitted[self.pairs[:, 1]])
        starts = np.flatnonzero(np.diff(self.pair, prepend=-1))
        games = np.add.reduceat(self.number * self.games, starts) + 1
        surprise = self.number * (self.games * (self.score - p[self.pair])) ** 2
        squares = np.add.reduceat(surprise, starts) + (0.5 - p) ** 2
        design = _design(self.pairs, len(fitted))[:, np.arange(len(fitted)) != anchor]
        inverse = cho_solve(_factor(design, games * p * (1 - p)), np.eye(design.shape[1]))
        variance = np.einsum("ij,ij->i", inverse @ _weighted(design, squares), inverse)
        return np.insert(np.sqrt(variance), anchor, 0.0)


def bradley_terry(points: Floats, games: Floats, pairs: Ints, size: int, anchor: int) -> Floats:
    """Fit ratings to many weightings of the same pairs at once.

    Args:
        points: Points of the first contestant of each pair, shape (resamples, p).
        games: Games of each pair, shape (resamples, p).
        pairs: Contestant numbers of each pair, int64 of shape (p, 2).
        size: Number of contestants.
        anchor: Number of the contestant whose log odds are 0.

    Returns:
        Maximum likelihood log odds, shape (resamples, size).
    """
    return _Model(pairs, size, anchor).fit(points, games)


class _Model:
    """Newton's method for many rows at once, each with its own points and games of the same pairs.

    Each step is solved by conjugate gradients with one preconditioner for all rows, so that one factorisation suffices.
    By default it is the mean of the rows' Hessians at each step; for one row, that is its Hessian.
    near: log odds (size,) near all solutions, at which `games` (1, p) define the preconditioner of all steps.
    """

    def __init__(
        self, pairs: Ints, size: int, anchor: int, near: Floats | None = None, games: Floats | None = None
    ) -> None:
        self._design, self._anchor = _design(pairs, size)[:, np.arange(size) != anchor], anchor
        self._start = np.delete(np.zeros(size) if near is None else near - near[anchor], anchor)
        self._factor = None
        if games is not None:
            p = expit(self._start @ self._design.T)
            self._factor = _factor(self._design, games[0] * p * (1 - p))

    def fit(self, points: Floats, games: Floats) -> Floats:
        """Maximum likelihood log odds (resamples, size) of each row."""
        theta, rows = np.repeat(self._start[None], len(points), axis=0), np.arange(len(points))
        while len(rows):
            step = self._step(theta[rows], points[rows], games[rows])
            theta[rows] += step
            rows = rows[np.abs(step).max(axis=1) > TOLERANCE]
        return np.insert(theta, self._anchor, 0.0, axis=1)

    def _step(self, theta: Floats, points: Floats, games: Floats) -> Floats:
        """A step of each row. Long steps are halved until the concave likelihood does not decrease."""
        gap = theta @ self._design.T
        p = expit(gap)
        step = self._solve(games * p * (1 - p), (points - games * p) @ self._design)
        long = np.flatnonzero(np.abs(step).max(axis=1) > LONG)
        if len(long):
            points, games, gap, step_gap = points[long], games[long], gap[long], step[long] @ self._design.T
            scale, floor = np.ones((len(long), 1)), _likelihood(points, games, gap) - 1e-9
            while (worse := _likelihood(points, games, gap + scale * step_gap) < floor).any():
                scale[worse] /= 2
            step[long] *= scale
        return step

    def _solve(self, information: Floats, gradient: Floats) -> Floats:
        """Solve `design.T diag(information) design x = gradient` for each row of x (resamples, n), up to `PRECISE`.

        Preconditioned conjugate gradients; J. Nocedal and S. Wright, "Numerical optimization" (2006), algorithm 5.3.
        """
        factor = self._factor or _factor(self._design, information.mean(axis=0))
        x, residual = np.zeros_like(gradient), gradient
        towards = solved = cho_solve(factor, residual.T, check_finite=False).T
        squared_norm = (residual * solved).sum(axis=1)
        enough = PRECISE**2 * squared_norm
        for _ in range(MOST_DIRECTIONS):
            if not (squared_norm > enough).any():
                break
            curved = (information * (towards @ self._design.T)) @ self._design
            # A converged row has a residual of zero.
            length = (squared_norm / np.maximum((towards * curved).sum(axis=1), TINY))[:, None]
            x, residual = x + length * towards, residual - length * curved
            solved = cho_solve(factor, residual.T, check_finite=False).T
            before, squared_norm = squared_norm, (residual * solved).sum(axis=1)
            towards = solved + (squared_norm / np.maximum(before, TINY))[:, None] * towards
        return x


def _design(pairs: Ints, size: int) -> csc_array:
    """The matrix (p, size) that maps log odds to the difference of each pair."""
    rows = np.tile(np.arange(len(pairs)), 2)
    return csc_array((np.repeat([1.0, -1.0], len(pairs)), (rows, pairs.T.reshape(-1))), shape=(len(pairs), size))


def _factor(design: csc_array, information: Floats) -> tuple[Floats, bool]:
    """Factorised Hessian for pairs with this `information` (p,)."""
    factor: tuple[Floats, bool] = cho_factor(_weighted(design, information), check_finite=False)
    return factor


def _weighted(design: csc_array, weight: Floats) -> Floats:
    """`design.T diag(weight) design`"""
    return np.asarray((design.T @ design.multiply(weight[:, None])).toarray())


def _likelihood(points: Floats, games: Floats, gap: Floats) -> Floats:
    return np.asarray((points * gap - games * np.logaddexp(0.0, gap)).sum(axis=1))
