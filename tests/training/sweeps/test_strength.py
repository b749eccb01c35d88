"""The strength of a trial: the mean of its scores, and its interval."""

import math

import pytest

from league.registry.training.strength import StrengthScore
from training.sweeps.strength import mean_strength


def test_a_single_score_keeps_its_interval() -> None:
    assert mean_strength([StrengthScore("script:random", 200, 0.8, 0.7, 0.875)]) == pytest.approx((0.8, 0.7, 0.875))


def test_the_interval_of_a_mean_is_narrower_than_those_of_its_scores() -> None:
    """Of n equal scores it is narrower by √n."""
    scores = [StrengthScore(f"tictactoe@{number}", 200, 0.6, 0.5, 0.7) for number in range(4)]
    assert mean_strength(scores) == pytest.approx((0.6, 0.55, 0.65))


def test_the_distances_to_the_bounds_add_up_in_quadrature() -> None:
    scores = [StrengthScore("a", 100, 0.5, 0.2, 0.9), StrengthScore("b", 100, 1.0, 0.6, 1.0)]
    mean, low, high = mean_strength(scores)
    assert mean == 0.75
    assert low == pytest.approx(0.75 - math.hypot(0.3, 0.4) / 2)
    assert high == pytest.approx(0.75 + 0.4 / 2)
