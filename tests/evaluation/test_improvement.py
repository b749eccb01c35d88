"""rliable's numbers, and what must hold for any scores."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from evaluation.improvement import iqm, probability_of_improvement, stratified_bootstrap

MATRICES = arrays(np.float64, (6, 3), elements=st.integers(-20, 20).map(float))


def test_the_numbers_of_rliable() -> None:
    scores = [[1, 2], [2, 2], [1, 1], [2, 1]]
    assert iqm(scores) == 1.5
    assert probability_of_improvement(scores, [[1, 1], [2, 2], [3, 3]]) == pytest.approx(1 / 3)


@given(MATRICES)
def test_iqm_is_the_mean_of_the_middle_half(scores: np.ndarray) -> None:
    middle = np.sort(scores, axis=None)[4:-4]
    assert iqm(scores) == pytest.approx(middle.mean())


@given(MATRICES, MATRICES)
def test_improvement_and_its_opposite_add_up(ours: np.ndarray, theirs: np.ndarray) -> None:
    there, back = probability_of_improvement(ours, theirs), probability_of_improvement(theirs, ours)
    assert there + back == pytest.approx(1)
    pairs = (ours[:, None] > theirs[None]) + 0.5 * (ours[:, None] == theirs[None])
    assert there == pytest.approx(pairs.mean())


def test_the_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    truth = 0.0  # of the IQM of a symmetric distribution around it
    covered = 0
    for seed in range(200):
        scores = rng.normal(size=(40, 5))
        found = stratified_bootstrap(iqm, scores, resamples=300, seed=seed)
        covered += found.low <= truth <= found.high
    assert 178 <= covered <= 199, "95 % of 200, within three and a half standard deviations"


def test_the_same_seed_gives_the_same_interval_and_tasks_are_kept_apart() -> None:
    scores = np.array([[0.0, 100.0], [1.0, 101.0], [2.0, 102.0]])
    first, again = (stratified_bootstrap(iqm, scores, resamples=200, seed=3) for _ in range(2))
    assert first == again
    assert 50 <= first.low <= first.value <= first.high <= 52, "half of each resample is of each task"


@pytest.mark.parametrize("scores", [[], [1.0, 2.0], [[float("nan")]], np.zeros((0, 3))])
def test_what_are_no_scores_is_refused(scores: object) -> None:
    with pytest.raises(ValueError, match="matrix"):
        iqm(scores)  # type: ignore[arg-type]


def test_other_tasks_are_refused() -> None:
    with pytest.raises(ValueError, match="same tasks"):
        probability_of_improvement([[1.0, 2.0]], [[1.0]])
