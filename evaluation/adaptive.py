"""The adaptive schedule: each round plays where a match says most about who is above whom. Pure.

Strengths follow the Bradley–Terry model with a wide normal prior, and are known as far as the results say: their
posterior is approximated by a normal one (Laplace). A match of i and j is worth

    P(the order of i and j is wrong) × the share of the variance of their gap that the match takes away,

which is Φ(-|m|/s) × w s² / (1 + w s²), where m and s² are the mean and variance of the gap, w = n p (1 - p) is the
information in the n games of a match, and p is the expected score. So nothing is spent on pairs whose order is plain,
nor on those who are too far apart to surprise. Within a round the variances shrink by what was chosen already, and
each step of the choice takes pairs of different contestants: that spreads a round, and keeps it fast.

Sources: M. E. Glickman and S. T. Jensen, "Adaptive paired comparison design", J. Stat. Planning and Inference 127
(2005), for choosing pairs by what they are expected to tell; M. Rowland et al., "Multiagent evaluation under incomplete
information", NeurIPS 2019, for leaving alone the pairs whose order is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import expit, ndtr

from evaluation.one_thread import one_thread
from league.results.records import BlockResult
from league.seeds import generator

Floats = NDArray[np.float64]
Pairing = tuple[int, int]

PRIOR = 600 * math.log(10) / 400
"""Standard deviation of strengths before any game, in log odds: 600 Elo."""

GROWTH = 16
"""A round adds a sixteenth of what was played before it, and a match per contestant at least."""

STEPS = 16
"""A large round plays a pair several times, so that its choice takes about this many steps at least, and no more than
a few times as many."""

WORTHWHILE = 0.5
"""A step leaves out pairs that are worth less than this part of the best one."""


def round_size(contestants: int, played: int) -> int:
    """How many matches the round behind the first `played` has. It depends on nothing else: a longer run goes on where
    a shorter one ended.
    """
    return max(contestants, played // GROWTH)


def ring(contestants: int, seed: int) -> list[Pairing]:
    """The first round: everybody meets two others, so that all are connected."""
    order = generator(seed, "ring").permutation(contestants).tolist()
    pairs = [(min(pair), max(pair)) for pair in zip(order, order[1:] + order[:1], strict=True)]
    return pairs if contestants > 2 else pairs[: contestants - 1]


def choose(points: Floats, games: Floats, number: int, comparisons: int = 2) -> list[Pairing]:
    """The `number` pairs that are worth playing most, the best first; a pair may be among them several times.

    points[i, j]: what i has scored against j in games[i, j] games, (n, n) each.
    comparisons: how many games a match counts for.
    """
    with one_thread():
        return _chosen(points, games, number, comparisons)


def _chosen(points: Floats, games: Floats, number: int, comparisons: int) -> list[Pairing]:
    strength, precision = posterior(points, games)
    first, second = np.triu_indices(len(games), 1)
    gap = strength[first] - strength[second]
    at_once = math.ceil(number / (STEPS * len(games)))
    information = at_once * comparisons * expit(gap) * expit(-gap)
    chosen: list[Pairing] = []
    while len(chosen) < number:
        covariance = _inverse(precision)
        own = np.diag(covariance)
        variance = own[first] + own[second] - 2 * covariance[first, second]
        told = information * variance
        value = ndtr(-np.abs(gap) / np.sqrt(variance)) * told / (1 + told)
        for pair in _disjoint(value, first, second):
            i, j = int(first[pair]), int(second[pair])
            chosen += [(i, j)] * at_once
            precision[[i, j], [i, j]] += information[pair]
            precision[[i, j], [j, i]] -= information[pair]
            if len(chosen) >= number:
                break
    return chosen[:number]


def tally(contestants: Mapping[str, int], results: Iterable[BlockResult]) -> tuple[Floats, Floats]:
    """Points and games of each pair, (n, n) each, as `choose` takes them. contestants: their numbers."""
    points, games = np.zeros((2, len(contestants), len(contestants)))
    for block in results:
        i, j = (contestants[ref] for ref in block.contestants)
        points[[i, j], [j, i]] += block.scores
        games[[i, j], [j, i]] += block.games
    return points, games


def posterior(points: Floats, games: Floats) -> tuple[Floats, Floats]:
    """The most likely log odds (n,) under the prior, and the precision (n, n) of a normal law around them."""
    strength = np.zeros(len(games))
    while True:
        expected = expit(strength[:, None] - strength)
        information = games * expected * (1 - expected)
        precision = np.diag(information.sum(axis=1) + PRIOR**-2) - information
        gradient = (points - games * expected).sum(axis=1) - strength / PRIOR**2
        step = cho_solve(cho_factor(precision), gradient)
        farthest = np.abs(step).max()
        if farthest < TOLERANCE:
            return strength, precision
        # Far from the maximum a full Newton step may overshoot; a unit of log odds at a time does not.
        strength = strength + step / max(1.0, farthest)


TOLERANCE = 1e-6
"""Log odds: the fit has settled."""


def _inverse(precision: Floats) -> Floats:
    return np.asarray(cho_solve(cho_factor(precision), np.eye(len(precision))))


def _disjoint(value: Floats, first: NDArray[np.intp], second: NDArray[np.intp]) -> Iterator[int]:
    """Indices of pairs of different contestants, the best first, as long as they are worth it."""
    busy = set()
    worthwhile = np.flatnonzero(value >= WORTHWHILE * value.max())
    for pair in worthwhile[np.argsort(-value[worthwhile], kind="stable")].tolist():
        i, j = int(first[pair]), int(second[pair])
        if i not in busy and j not in busy:
            busy |= {i, j}
            yield pair
