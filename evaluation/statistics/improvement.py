"""Compares two training methods by scores of several runs on several tasks, with the statistics of rliable.

Scores are matrices (runs, tasks): a run is one training with one seed; a task is a league or one of its sides.
Intervals come from a bootstrap that resamples runs within each task, so that every task keeps its weight.

Source: R. Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, stdtrit
from scipy.stats import rankdata, trim_mean

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BootstrapEstimate:
    """A statistic with the bounds of a two-sided interval."""

    value: float
    low: float
    high: float


def iqm(scores: ArrayLike) -> float:
    """Interquartile mean of scores (runs, tasks): the mean without the top and bottom quarter."""
    return float(trim_mean(_scores(scores), 0.25, axis=None))


def probability_of_improvement(scores: ArrayLike, baseline: ArrayLike) -> float:
    """Probability that a run scores more than a run of the baseline on the same task, averaged over tasks.

    This is the Mann-Whitney U statistic divided by the number of pairs. Ties count one half.

    Args:
        scores: Scores of the method, shape (runs, tasks).
        baseline: Scores of the baseline, shape (baseline runs, tasks).

    Raises:
        ValueError: If the numbers of tasks differ.
    """
    ours, theirs = _scores(scores), _scores(baseline)
    if ours.shape[1] != theirs.shape[1]:
        raise ValueError(f"numbers of tasks differ: {ours.shape[1]} and {theirs.shape[1]}")
    runs = len(ours)
    ranks = rankdata(np.concatenate([ours, theirs]), axis=0)[:runs]
    above = ranks.sum(axis=0) - runs * (runs + 1) / 2
    return float((above / (runs * len(theirs))).mean())


def stratified_bootstrap(
    statistic: Callable[..., float],
    *scores: ArrayLike,
    resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> BootstrapEstimate:
    """A statistic of scores with a stratified bootstrap interval.

    Each resample draws as many runs as there are, with replacement, independently in each task and matrix. Because
    resamples of few runs vary too little, the quantiles are moved outwards according to Student's distribution and the
    lost degree of freedom of each task (the expanded percentile interval of T. Hesterberg, "What teachers should know
    about the bootstrap", The American Statistician 69, 2015). A single run of a task has no interval.

    Args:
        statistic: Function of one or more matrices (runs, tasks).
        scores: The arguments of `statistic`.
        resamples: Number of resamples.
        confidence: Coverage of the interval.
        seed: Seed of the resamples.
    """
    matrices = [_scores(matrix) for matrix in scores]
    rng = np.random.default_rng(seed)

    def resample(matrix: Floats) -> Floats:
        return np.take_along_axis(matrix, rng.integers(len(matrix), size=matrix.shape), axis=0)

    values = [statistic(*map(resample, matrices)) for _ in range(resamples)]
    tail = _expanded((1 - confidence) / 2, matrices)
    low, high = np.quantile(values, [tail, 1 - tail])
    return BootstrapEstimate(statistic(*matrices), float(low), float(high))


def _expanded(tail: float, scores: Sequence[Floats]) -> float:
    """Quantile of bootstrap values at which the interval leaves `tail` on either side."""
    fewest = min(len(matrix) for matrix in scores)
    if fewest == 1:
        return 0.0
    freedom = sum(matrix.shape[1] * (len(matrix) - 1) for matrix in scores)
    return float(ndtr(-math.sqrt(fewest / (fewest - 1)) * stdtrit(freedom, 1 - tail)))


def _scores(scores: ArrayLike) -> Floats:
    matrix = np.asarray(scores, dtype=np.float64)
    if matrix.ndim != 2 or not matrix.size or not np.isfinite(matrix).all():
        raise ValueError(f"scores must be a matrix (runs, tasks) of finite numbers, got shape {matrix.shape}")
    return matrix
