"""rliable's numbers, and properties for any scores."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import stdtrit

from evaluation.statistics.improvement import iqm, probability_of_improvement, stratified_bootstrap
from tests.support.closeness import close

MATRICES = arrays(np.float64, (6, 3), elements=st.integers(-20, 20).map(float))


def test_values_equal_those_of_rliable() -> None:
    scores = [[1, 2], [2, 2], [1, 1], [2, 1]]
    assert iqm(scores) == pytest.approx(1.5)
    assert probability_of_improvement(scores, [[1, 1], [2, 2], [3, 3]]) == pytest.approx(1 / 3)


@given(MATRICES)
def test_iqm_is_the_mean_of_the_middle_half(scores: np.ndarray) -> None:
    middle = np.sort(scores, axis=None)[4:-4]
    assert iqm(scores) == pytest.approx(middle.mean())


@given(MATRICES, MATRICES)
def test_improvement_and_its_opposite_sum_to_one(ours: np.ndarray, theirs: np.ndarray) -> None:
    forward, backward = probability_of_improvement(ours, theirs), probability_of_improvement(theirs, ours)
    assert forward + backward == pytest.approx(1)
    pairs = (ours[:, None] > theirs[None]) + 0.5 * (ours[:, None] == theirs[None])
    assert forward == pytest.approx(pairs.mean())


def test_the_interval_has_its_coverage() -> None:
    """With the mean, which is faster than the IQM; `benchmarks.simulations.coverage` measures the IQM's interval."""
    rng = np.random.default_rng(0)
    truth = covered = 0
    for seed in range(200):
        scores = rng.normal(size=(40, 5))
        found = stratified_bootstrap(lambda resample: float(resample.mean()), scores, resamples=300, seed=seed)
        covered += found.low <= truth <= found.high
    assert 178 <= covered <= 199, "95 % of 200, within 3.5 standard deviations"


def test_the_interval_of_few_runs_is_as_wide_as_students() -> None:
    """Unexpanded percentiles of three runs are about a quarter too narrow."""
    runs, tasks = 3, 10
    scores = np.random.default_rng(0).normal(size=(runs, tasks))
    found = stratified_bootstrap(lambda resample: float(resample.mean()), scores)
    error = np.sqrt(scores.var(axis=0, ddof=1).sum() / runs) / tasks
    expected = 2 * stdtrit(tasks * (runs - 1), 0.975) * error
    assert found.high - found.low == pytest.approx(expected, rel=0.1)


def test_intervals_are_reproducible_and_stratified_by_task() -> None:
    scores = np.array([[0.0, 100.0], [1.0, 101.0], [2.0, 102.0]])
    first, second = (stratified_bootstrap(iqm, scores, resamples=200, seed=3) for _ in range(2))
    assert close(first, second)
    assert 50 <= first.low <= first.value <= first.high <= 52, "each task contributes half of each resample"


@pytest.mark.parametrize("scores", [[], [1.0, 2.0], [[float("nan")]], np.zeros((0, 3))])
def test_invalid_scores_are_rejected(scores: object) -> None:
    with pytest.raises(ValueError, match="matrix"):
        iqm(scores)  # type: ignore[arg-type]


def test_different_tasks_are_rejected() -> None:
    with pytest.raises(ValueError, match="numbers of tasks differ"):
        probability_of_improvement([[1.0, 2.0]], [[1.0]])
