"""Bradley–Terry ratings of all contestants from the blocks they played, with intervals.

The model: contestant `i` scores against `j` with expectation `1 / (1 + 10^((r_j - r_i)/400))`, a draw counting as
half a win for each. Ratings maximise the likelihood of all games plus a stated prior: **one virtual draw per
pair that has played**, so that an undefeated contestant stays finite. They are anchored: one contestant's
rating is 0 by definition. Who is connected to the anchor by no chain of games has no rating.

Intervals come from the Bayesian bootstrap over blocks (weights of independent Exp(1) law on each block, and
on the virtual draw as one more observation), refitting at each resample: the block, not the game, is the
independent unit, and a series without a single defeat still gets an honest, wide interval where resampling
with replacement would give none.

Sources: R. A. Bradley and M. E. Terry, "Rank analysis of incomplete block designs" (1952); D. R. Hunter, "MM
algorithms for generalized Bradley–Terry models" (2004) for existence and connectedness; D. B. Rubin, "The
Bayesian bootstrap" (1981); M. A. Newton and A. E. Raftery, "Approximate Bayesian inference with the weighted
likelihood bootstrap" (1994).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.special import expit

from league.results.records import BlockResult

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ELO = 400 / math.log(10)
"""Elo per unit of log odds."""

TOLERANCE = 1e-3 / ELO
"""A fit has settled when no rating moves by more than a thousandth of an Elo."""

CELLS_AT_ONCE = 4_000_000
"""Resamples are worked off in chunks of at most this many random numbers, which bounds memory."""


@dataclass(frozen=True, slots=True)
class Rating:
    """Elo above the anchor with the bounds of its interval, all None without a chain of games to the anchor."""

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
    """Rate everybody in `results`, blocks of two contestants each; the anchor is at 0.

    The answer depends on the blocks and the seed, not on the order of the blocks.
    """
    blocks = list(results)
    names = sorted({anchor}.union(*(block.contestants for block in blocks)))
    number = {name: i for i, name in enumerate(names)}
    table = _Table.of(blocks, number)
    rated = _connected(table, len(names), number[anchor])
    index = np.cumsum(rated) - 1
    table = table.only(rated[table.pairs[:, 0]], index)
    ratings = dict.fromkeys(names, Rating(None, None, None)) | {anchor: Rating(0.0, 0.0, 0.0)}
    size, base = int(rated.sum()), int(index[number[anchor]])
    if size > 1:
        elo = ELO * bradley_terry(*table.sums(), table.pairs, size, base)[0]
        tail = (1 - confidence) / 2 * 100
        spread = ELO * table.resampled(size, base, resamples, seed)
        low, high = np.percentile(spread, (tail, 100 - tail), axis=0)
        for name in itertools.compress(names, rated):
            ratings[name] = Rating(*(float(x[index[number[name]]]) for x in (elo, low, high)))
    return ratings


@dataclass(frozen=True, slots=True)
class _Table:
    """Blocks counted by (pair, score, games); row `k` is `number[k]` equal blocks of pair `pair[k]`."""

    pairs: Ints  # (p, 2), first < second
    pair: Ints  # (k,)
    score: Floats  # (k,) of the first of the pair
    games: Floats  # (k,)
    number: Floats  # (k,)

    @classmethod
    def of(cls, blocks: Sequence[BlockResult], number: Mapping[str, int]) -> _Table:
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

    def only(self, kept: NDArray[np.bool_], index: Ints) -> _Table:
        """The pairs `kept`, their contestants renumbered by `index`."""
        rows = kept[self.pair]
        renumbered = (np.cumsum(kept) - 1)[self.pair[rows]]
        return _Table(index[self.pairs[kept]], renumbered, self.score[rows], self.games[rows], self.number[rows])

    def sums(self, weight: Floats | None = None, prior: Floats | None = None) -> tuple[Floats, Floats]:
        """Points of the first of each pair, and games, each (resamples, p), prior included."""
        weight = self.number[None] if weight is None else weight
        prior = np.ones((1, len(self.pairs))) if prior is None else prior
        starts = np.flatnonzero(np.diff(self.pair, prepend=-1))
        games = np.add.reduceat(weight * self.games, starts, axis=1) + prior
        points = np.add.reduceat(weight * (self.games * self.score), starts, axis=1) + prior / 2
        return points, games

    def resampled(self, size: int, anchor: int, resamples: int, seed: int) -> Floats:
        """Log odds (resamples, size) refitted under random weights; `k` blocks of one kind weigh Gamma(k, 1)
        together.
        """
        rng = np.random.default_rng(seed)
        chunk = max(1, min(resamples, CELLS_AT_ONCE // len(self.number)))
        fitted = []
        for start in range(0, resamples, chunk):
            rows = min(chunk, resamples - start)
            weight = rng.standard_gamma(self.number, size=(rows, len(self.number)))
            prior = rng.standard_exponential(size=(rows, len(self.pairs)))
            fitted.append(bradley_terry(*self.sums(weight, prior), self.pairs, size, anchor))
        return np.concatenate(fitted)


def _connected(table: _Table, contestants: int, anchor: int) -> NDArray[np.bool_]:
    first, second = table.pairs.T
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(contestants, contestants))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(labels == labels[anchor])


def bradley_terry(points: Floats, games: Floats, pairs: Ints, size: int, anchor: int) -> Floats:
    """Log odds (resamples, size) that maximise the likelihood of each row of `points` and `games` (resamples, p).

    Newton steps in which rows share one matrix, the Hessian at their mean: one factorisation per step, however many
    resamples there are. A group of rows too different for that is split in two; a row alone is Newton's method proper.
    """
    design = _design(pairs, size)
    theta, groups = np.zeros((len(points), size)), [np.arange(len(points))]
    while groups:
        rows = groups.pop()
        theta[rows], unsettled = _newton(theta[rows], points[rows], games[rows], design, anchor)
        rest = rows[unsettled]
        if len(rest) > 1:
            spread = theta[rest].var(axis=0).argmax()
            rest = rest[np.argsort(theta[rest, spread])]
        groups.extend(half for half in np.array_split(rest, min(2, len(rest)) or 1) if len(half))
    return theta


def _design(pairs: Ints, size: int) -> csr_array:
    """The matrix (p, size) that takes log odds to the gap of each pair."""
    rows = np.tile(np.arange(len(pairs)), 2)
    return csr_array((np.repeat([1.0, -1.0], len(pairs)), (rows, pairs.T.reshape(-1))), shape=(len(pairs), size))


def _newton(
    theta: Floats, points: Floats, games: Floats, design: csr_array, anchor: int, steps: int = 20
) -> tuple[Floats, NDArray[np.bool_]]:
    """At most `steps` damped Newton steps from `theta`; returns where they led, and which rows have not settled.

    A row's step is halved until its concave likelihood does not fall.
    """
    free = np.arange(theta.shape[1]) != anchor
    mean_games = games.mean(axis=0)
    for _ in range(steps):
        gap = theta @ design.T
        gradient = (points - games * expit(gap)) @ design
        p = expit(gap.mean(axis=0))
        hessian = (design.T @ design.multiply((mean_games * p * (1 - p))[:, None])).toarray()[np.ix_(free, free)]
        step = np.zeros_like(theta)
        step[:, free] = cho_solve(cho_factor(hessian), gradient[:, free].T).T
        step_gap = step @ design.T
        scale, floor = np.ones((len(theta), 1)), _likelihood(points, games, gap) - 1e-9
        while (worse := _likelihood(points, games, gap + scale * step_gap) < floor).any():
            scale[worse] /= 2
        theta = theta + scale * step
        unsettled = np.abs(step).max(axis=1) > TOLERANCE
        if not unsettled.any():
            break
    return theta, unsettled


def _likelihood(points: Floats, games: Floats, gap: Floats) -> Floats:
    return np.asarray((points * gap - games * np.logaddexp(0.0, gap)).sum(axis=1))
