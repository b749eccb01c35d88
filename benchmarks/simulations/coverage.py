"""Do nominal 95 % intervals cover the true value 95 % of the time? Simulations with a fixed number of blocks."""

from __future__ import annotations

import numpy as np

from benchmarks.simulations.simulated_gates import CELLS, EQUALS, stronger
from evaluation.statistics.bradley_terry import rate
from evaluation.statistics.improvement import iqm, probability_of_improvement, stratified_bootstrap
from evaluation.statistics.sequential import elo_estimate, elo_of
from league.results.records import Outcome

BLOCKS = 200
TRUTH = 40.0
"""Elo of the challenger."""
RUNS, TASKS = 40, 5
RESAMPLES = 400


def elo(simulations: int, seed: int) -> float:
    """Coverage of `elo_estimate`, logistic, after 200 blocks of two games."""
    shares = stronger(EQUALS["drawish"], TRUTH, "logistic")
    truth = float(elo_of(float(shares @ CELLS)))
    counts = np.random.default_rng(seed).multinomial(BLOCKS, shares, size=simulations)
    return float(np.mean([estimate.low <= truth <= estimate.high for estimate in map(_estimate, counts)]))


def _estimate(counts: np.ndarray) -> object:
    return elo_estimate(counts, "logistic")


def rating(simulations: int, seed: int) -> float:
    """Coverage of Bradley–Terry ratings: three contestants, 200 blocks per pair."""
    rng = np.random.default_rng(seed)
    truth = {"a": 0.0, "b": 40.0, "c": 90.0}
    covered = []
    for _ in range(simulations):
        blocks = [block for pair in ("ab", "ac", "bc") for block in _blocks(pair, truth, rng)]
        rated = rate(blocks, "a")
        for name in "bc":
            low, high = rated[name].low, rated[name].high
            assert low is not None
            assert high is not None
            covered.append(low <= truth[name] <= high)
    return float(np.mean(covered))


def _blocks(pair: str, truth: dict[str, float], rng: np.random.Generator) -> list[Outcome]:
    first, second = pair
    shares = stronger(EQUALS["decisive"], truth[first] - truth[second], "logistic")
    points = 2 * CELLS[rng.choice(5, p=shares, size=BLOCKS)]
    return [Outcome((first, second), 2, (float(p), float(2 - p))) for p in points]


def interquartile_mean(simulations: int, seed: int) -> float:
    """Coverage of the IQM of 40 runs on 5 tasks (200 scores) with the stratified bootstrap. Scores are uniform around a
    mean of each task; the true value is the IQM of ten million draws.
    """
    rng = np.random.default_rng(seed)
    truth = iqm(_scores(rng, 2_000_000))
    covered = 0
    for number in range(simulations):
        estimate = stratified_bootstrap(iqm, _scores(rng, RUNS), resamples=RESAMPLES, seed=number)
        covered += estimate.low <= truth <= estimate.high
    return covered / simulations


def improvement(simulations: int, seed: int) -> float:
    """Coverage of the probability of improvement of such a set of runs over another one that is 0.1 worse."""
    rng = np.random.default_rng(seed)
    # P(X + 0.1 > Y) for uniform X and Y is 1 - (1 - 0.1)² / 2.
    truth = 1 - 0.9**2 / 2
    covered = 0
    for number in range(simulations):
        ours, theirs = _scores(rng, RUNS) + 0.1, _scores(rng, RUNS)
        estimate = stratified_bootstrap(probability_of_improvement, ours, theirs, resamples=RESAMPLES, seed=number)
        covered += estimate.low <= truth <= estimate.high
    return covered / simulations


def _scores(rng: np.random.Generator, runs: int) -> np.ndarray:
    return np.asarray(rng.random((runs, TASKS)) + np.linspace(0, 0.4, TASKS))
