"""Adaptive pairing: schedules the matches that reduce the uncertainty of the ranking most. Pure.

Strengths are the ratings of `evaluation.statistics.bradley_terry`. The value of a match, (1 + Φ(-m/s)) × w s² / (1 + w
s²), and the choice of a round are explained in docs/statistics.md.

Sources: M. E. Glickman and S. T. Jensen, "Adaptive paired comparison design", J. Stat. Planning and Inference 127
(2005), for choosing pairs by expected information; M. Rowland et al., "Multiagent evaluation under incomplete
information", NeurIPS 2019, for skipping pairs with a known order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import expit, ndtr

from evaluation.statistics.blas import single_threaded_blas
from evaluation.statistics.bradley_terry import ELO, posterior
from league.random.seeds import generator
from league.results.records import BlockResult

Floats = NDArray[np.float64]
Pairing = tuple[int, int]

NEAR = 300 / ELO
"""Log odds below which pairs are equally informative. Otherwise the results would decide which pairs play: a pair of
neighbours would play until it seems farther apart than it is, and all together would stretch the ladder."""

GROWTH = 16
"""A round adds a sixteenth of the matches so far, and at least one per contestant."""

STEPS = 16
"""Approximate minimum number of steps to choose a round. A large round plays a pair several times."""

WORTHWHILE = 0.5
"""A step skips pairs whose value is below this share of the best one."""


def round_size(contestants: int, played: int) -> int:
    """Number of matches of the round after `played` matches, independent of earlier rounds."""
    return max(contestants, played // GROWTH)


def ring(contestants: int, seed: int) -> list[Pairing]:
    """The first round: every contestant meets two others, so that all are connected."""
    order = generator(seed, "ring").permutation(contestants).tolist()
    pairs = [(min(pair), max(pair)) for pair in zip(order, order[1:] + order[:1], strict=True)]
    return pairs if contestants > 2 else pairs[: contestants - 1]


def choose(points: Floats, games: Floats, number: int, comparisons: int = 2) -> list[Pairing]:
    """The `number` most valuable pairs, best first. Pairs may repeat.

    Args:
        points: `points[i, j]`: what i scored against j, shape (n, n).
        games: Number of games of each pair, shape (n, n).
        number: Number of matches to choose.
        comparisons: Games that a match counts for.
    """
    with single_threaded_blas():
        return _chosen(points, games, number, comparisons)


def _chosen(points: Floats, games: Floats, number: int, comparisons: int) -> list[Pairing]:
    strength, precision = posterior(points, games)
    first, second = np.triu_indices(len(games), 1)
    gap = np.abs(strength[first] - strength[second])
    at_once = math.ceil(number / (STEPS * len(games)))
    pairings: list[Pairing] = []
    while len(pairings) < number:
        covariance = cho_solve(cho_factor(precision), np.eye(len(precision)))
        diagonal = np.diag(covariance)
        variance = diagonal[first] + diagonal[second] - 2 * covariance[first, second]
        # The mean of p (1 - p) under the posterior, by the probit approximation of the logistic function.
        likely = np.where(gap < NEAR, 0.0, gap / np.sqrt(1 + math.pi * variance / 8))
        information = at_once * comparisons * expit(likely) * expit(-likely)
        gain = information * variance
        value = (1 + ndtr(-gap / np.sqrt(variance))) * gain / (1 + gain)
        for pair in _disjoint(value, first, second):
            i, j = int(first[pair]), int(second[pair])
            pairings += [(i, j)] * at_once
            precision[[i, j], [i, j]] += information[pair]
            precision[[i, j], [j, i]] -= information[pair]
            if len(pairings) >= number:
                break
    return pairings[:number]


def tally(contestants: Mapping[str, int], results: Iterable[BlockResult]) -> tuple[Floats, Floats]:
    """Points and games of each pair, (n, n) each, as `choose` takes them. contestants: reference → number."""
    points, games = np.zeros((2, len(contestants), len(contestants)))
    for block in results:
        i, j = (contestants[ref] for ref in block.contestants)
        points[[i, j], [j, i]] += block.scores
        games[[i, j], [j, i]] += block.games
    return points, games


def _disjoint(value: Floats, first: NDArray[np.intp], second: NDArray[np.intp]) -> Iterator[int]:
    """Indices of pairs of different contestants, best first, while they are worthwhile."""
    busy = set()
    worthwhile = np.flatnonzero(value >= WORTHWHILE * value.max())
    for pair in worthwhile[np.argsort(-value[worthwhile], kind="stable")].tolist():
        i, j = int(first[pair]), int(second[pair])
        if i not in busy and j not in busy:
            busy |= {i, j}
            yield pair
