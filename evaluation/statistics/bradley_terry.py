"""Bradley–Terry ratings of all contestants from the blocks they played, with intervals.

Contestant `i` scores against `j` with expectation `1 / (1 + 10^((r_j - r_i)/400))`; a draw counts as half a win for
each. Ratings maximise the likelihood of all games plus a prior of **one virtual draw per pair that has played**. The
rating of the anchor is 0 by definition. Intervals come from the Bayesian bootstrap over blocks and virtual draws, or,
for very large tables, from the asymptotically equivalent sandwich estimator.

The random weights of a pair depend on the pair and its blocks only, and are kept from one call to the next. After new
blocks of one pair, those of the others are neither drawn again nor different.

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
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.special import expit, ndtri

from evaluation.statistics.blas import single_threaded_blas
from league.random.seeds import generator
from league.results.records import Outcome

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ELO = 400 / math.log(10)
"""Elo per unit of log odds."""

TOLERANCE = 1e-3 / ELO
"""A fit has converged when no rating moves by more than a thousandth of an Elo."""

RESAMPLED = 0.5 / ELO
"""The same for resamples. The next step would be PRECISE times as long, a hundredth of an Elo."""

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

CELLS_AT_ONCE = 250_000
"""Pairs times resamples that are fitted at once, so that they fit into caches."""

KEPT_PAIRS = 4096
"""Pairs whose random weights are kept: 32 MB with 1,000 resamples."""


@dataclass(frozen=True, slots=True)
class Rating:
    """Elo above the anchor with the bounds of its interval; all None without a chain of games to the anchor."""

    elo: float | None
    low: float | None
    high: float | None


def rate(
    results: Iterable[Outcome],
    anchor: str,
    *,
    resamples: int = 1000,
    confidence: float = 0.95,
    seed: int = 0,
) -> dict[str, Rating]:
    """Rate all contestants in `results`. The result does not depend on their order.

    Args:
        results: Outcomes of matches (blocks), of two contestants each.
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
    rated_names = tuple(itertools.compress(names, rated))
    ratings = dict.fromkeys(names, Rating(None, None, None)) | {anchor: Rating(0.0, 0.0, 0.0)}
    size, base = int(rated.sum()), int(index[number[anchor]])
    if size > 1:
        with single_threaded_blas():
            fitted, low, high = _fitted(table, rated_names, base, resamples, (1 - confidence) / 2, seed)
        for name in rated_names:
            ratings[name] = Rating(*(float(ELO * x[index[number[name]]]) for x in (fitted, low, high)))
    return ratings


def _fitted(
    table: _BlockTable, names: Sequence[str], base: int, resamples: int, tail: float, seed: int
) -> tuple[Floats, Floats, Floats]:
    """Log odds (size,) and the bounds of their intervals. names: of the contestants (size,)."""
    points, games = table.sums()
    fitted = _Model(table.pairs, len(names), base).fit(points[:, None], games[:, None])[:, 0]
    if resamples * len(table.number) > MOST_CELLS:
        half = float(ndtri(1 - tail)) * table.deviation(fitted, base)
        return fitted, fitted - half, fitted + half
    low, high = np.quantile(table.resampled(names, fitted, base, resamples, seed), (tail, 1 - tail), axis=1)
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
    def of(cls, blocks: Sequence[Outcome], number: Mapping[str, int]) -> _BlockTable:
        players = np.array([[number[name] for name in block.contestants] for block in blocks], dtype=np.int64)
        players = players.reshape(-1, 2)
        games = np.array([block.games for block in blocks], dtype=np.float64)
        score = np.array([block.scores[0] for block in blocks], dtype=np.float64) / games
        swapped = players[:, 0] > players[:, 1]
        rows = np.column_stack([np.sort(players, axis=1), np.where(swapped, 1 - score, score), games])
        rivals = players[:, 0] != players[:, 1]
        cells, cell = np.unique(rows[rivals], axis=0, return_inverse=True)
        matches = np.array([block.matches for block in blocks], dtype=np.float64)[rivals]
        count = np.asarray(np.bincount(cell.reshape(-1), matches, minlength=len(cells)), dtype=np.float64)
        pairs, pair = np.unique(cells[:, :2].astype(np.int64), axis=0, return_inverse=True)
        return cls(pairs, pair.reshape(-1), cells[:, 2], cells[:, 3], count)

    def only(self, kept: NDArray[np.bool_], index: Ints) -> _BlockTable:
        """The pairs `kept`, with contestants renumbered by `index`."""
        rows = kept[self.pair]
        renumbered = (np.cumsum(kept) - 1)[self.pair[rows]]
        return _BlockTable(index[self.pairs[kept]], renumbered, self.score[rows], self.games[rows], self.number[rows])

    def sums(self) -> tuple[Floats, Floats]:
        """Points of the first of each pair, and games, each (p,), including the prior."""
        games = np.add.reduceat(self.number * self.games, self._starts) + 1
        points = np.add.reduceat(self.number * self.games * self.score, self._starts) + 0.5
        return points, games

    def resampled(self, names: Sequence[str], fitted: Floats, anchor: int, resamples: int, seed: int) -> Floats:
        """Log odds (size, resamples) refitted under random weights, starting at `fitted` (size,)."""
        rows = list(zip(self.score.tolist(), self.games.tolist(), self.number.tolist(), strict=True))
        bounds = itertools.pairwise([*self._starts.tolist(), len(rows)])
        sums = np.stack(
            [
                _random_sums((names[i], names[j]), tuple(rows[start:end]), resamples, seed)
                for (i, j), (start, end) in zip(self.pairs.tolist(), bounds, strict=True)
            ],
            axis=1,
        )
        chunk = max(1, CELLS_AT_ONCE // len(self.pairs))
        model = _Model(self.pairs, len(fitted), anchor, near=fitted, games=self.sums()[1])
        parts = (sums[:, :, start : start + chunk].astype(np.float64) for start in range(0, resamples, chunk))
        return np.concatenate([model.fit(points, games) for points, games in parts], axis=1)

    @property
    def _starts(self) -> NDArray[np.intp]:
        """The first row of each pair (p,)."""
        return np.flatnonzero(np.diff(self.pair, prepend=-1))

    def deviation(self, fitted: Floats, anchor: int) -> Floats:
        """Asymptotic standard deviation (size,) of the log odds under random weights.

        The sandwich `H^-1 J H^-1` of the Hessian H and the sum J of squared gradients of blocks and virtual draws.
        """
        p = expit(fitted[self.pairs[:, 0]] - fitted[self.pairs[:, 1]])
        surprise = self.number * (self.games * (self.score - p[self.pair])) ** 2
        squares = np.add.reduceat(surprise, self._starts) + (0.5 - p) ** 2
        design = _design(self.pairs, len(fitted))[:, np.arange(len(fitted)) != anchor]
        inverse = cho_solve(_factor(design, self.sums()[1] * p * (1 - p)), np.eye(design.shape[1]))
        variance = np.einsum("ij,ij->i", inverse @ _weighted(design, squares), inverse)
        return np.insert(np.sqrt(variance), anchor, 0.0)


@lru_cache(maxsize=KEPT_PAIRS)
def _random_sums(
    pair: tuple[str, str], rows: tuple[tuple[float, float, float], ...], resamples: int, seed: int
) -> NDArray[np.float32]:
    """Points of the first of a pair, and games, under random weights, (2, resamples), including the prior.

    rows: scores, games and numbers of its blocks. `k` blocks of one kind together have a Gamma(k, 1) weight.
    """
    score, games, number = np.array(rows).T
    random = generator(seed, *pair)
    weight = random.standard_gamma(number[:, None], size=(len(number), resamples))
    prior = np.multiply.outer([0.5, 1.0], random.standard_exponential(resamples))
    return (np.stack([games * score, games]) @ weight + prior).astype(np.float32)


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
    return _Model(pairs, size, anchor).fit(np.ascontiguousarray(points.T), np.ascontiguousarray(games.T)).T


class _Model:
    """Newton's method for many columns at once, each with its own points and games of the same pairs.

    Each step is solved by conjugate gradients with one preconditioner for all columns, so that one factorisation
    suffices. By default it is the mean of their Hessians at each step; for one column, that is its Hessian.
    near: log odds (size,) near all solutions, at which `games` (p,) define the preconditioner of all steps.
    """

    def __init__(
        self, pairs: Ints, size: int, anchor: int, near: Floats | None = None, games: Floats | None = None
    ) -> None:
        self._design, self._anchor = _design(pairs, size)[:, np.arange(size) != anchor], anchor
        self._start = np.delete(np.zeros(size) if near is None else near - near[anchor], anchor)
        self._factor, self._tolerance = None, TOLERANCE
        if games is not None:
            self._tolerance = RESAMPLED
            p = expit(self._design @ self._start)
            self._factor = _factor(self._design, games * p * (1 - p))

    def fit(self, points: Floats, games: Floats) -> Floats:
        """Maximum likelihood log odds (size, k) for points and games (p, k)."""
        theta, columns = np.repeat(self._start[:, None], points.shape[1], axis=1), np.arange(points.shape[1])
        while len(columns):
            step = self._step(theta[:, columns], points, games)
            theta[:, columns] += step
            moving = np.abs(step).max(axis=0) > self._tolerance
            if not moving.all():
                columns, points, games = columns[moving], points[:, moving], games[:, moving]
        return np.insert(theta, self._anchor, 0.0, axis=0)

    def _step(self, theta: Floats, points: Floats, games: Floats) -> Floats:
        """A step of each column. Long steps are halved until the concave likelihood does not decrease."""
        gap = self._design @ theta
        p = expit(gap)
        expected = games * p
        step = self._solve(expected * (1 - p), self._design.T @ (points - expected))
        long = np.flatnonzero(np.abs(step).max(axis=0) > LONG)
        if len(long):
            points, games, gap, step_gap = points[:, long], games[:, long], gap[:, long], self._design @ step[:, long]
            scale, floor = np.ones(len(long)), _likelihood(points, games, gap) - 1e-9
            while (worse := _likelihood(points, games, gap + scale * step_gap) < floor).any():
                scale[worse] /= 2
            step[:, long] *= scale
        return step

    def _solve(self, information: Floats, gradient: Floats) -> Floats:
        """Solve `design.T diag(information) design x = gradient` for each column of x (n, k), up to `PRECISE`.

        Preconditioned conjugate gradients; J. Nocedal and S. Wright, "Numerical optimization" (2006), algorithm 5.3.
        """
        factor = self._factor or _factor(self._design, information.mean(axis=1))
        x, residual = np.zeros_like(gradient), gradient
        towards = solved = cho_solve(factor, residual, check_finite=False)
        squared_norm = (residual * solved).sum(axis=0)
        enough = PRECISE**2 * squared_norm
        for _ in range(MOST_DIRECTIONS):
            if not (squared_norm > enough).any():
                break
            curved = self._design.T @ (information * (self._design @ towards))
            # A converged column has a residual of zero.
            length = squared_norm / np.maximum((towards * curved).sum(axis=0), TINY)
            x, residual = x + length * towards, residual - length * curved
            solved = cho_solve(factor, residual, check_finite=False)
            before, squared_norm = squared_norm, (residual * solved).sum(axis=0)
            towards = solved + (squared_norm / np.maximum(before, TINY)) * towards
        return x


def _design(pairs: Ints, size: int) -> csr_array:
    """The matrix (p, size) that maps log odds to the difference of each pair."""
    rows = np.tile(np.arange(len(pairs)), 2)
    return csr_array((np.repeat([1.0, -1.0], len(pairs)), (rows, pairs.T.reshape(-1))), shape=(len(pairs), size))


def _factor(design: csr_array, information: Floats) -> tuple[Floats, bool]:
    """Factorised Hessian for pairs with this `information` (p,)."""
    factor: tuple[Floats, bool] = cho_factor(_weighted(design, information), check_finite=False)
    return factor


def _weighted(design: csr_array, weight: Floats) -> Floats:
    """`design.T diag(weight) design`"""
    return np.asarray((design.T @ design.multiply(weight[:, None])).toarray())


def _likelihood(points: Floats, games: Floats, gap: Floats) -> Floats:
    return np.asarray((points * gap - games * np.logaddexp(0.0, gap)).sum(axis=0))
