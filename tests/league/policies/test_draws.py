"""Draws at the limits of the random number generator."""

from typing import Any, cast

import numpy as np
import pytest

from league.errors import ConfigError, InvalidInput
from league.policies.draws import choose, draw, sample
from league.spaces import Box, Discrete, MultiBinary, MultiDiscrete


class Fixed:
    """A generator that always returns the same number."""

    def __init__(self, number: float) -> None:
        self._number = number

    def random(self, shape: Any = None) -> Any:
        return self._number if shape is None else np.full(shape, self._number)


def fixed(*numbers: float) -> list[np.random.Generator]:
    return [cast(np.random.Generator, Fixed(number)) for number in numbers]


LOWEST, HIGHEST = 0.0, 1 - 2**-53


def test_extreme_random_numbers_choose_allowed_actions() -> None:
    allowed = np.array([[0, 0, 1, 1, 0]] * 4, np.int8)
    assert choose(allowed, np.array([LOWEST, 0.4999, 0.5, HIGHEST])).tolist() == [2, 2, 3, 3]


def test_extreme_random_numbers_sample_possible_actions() -> None:
    logits = np.array([[-1e9, 0.0, np.log(3.0), -1e9]] * 4, np.float32)
    assert sample(logits, Discrete(n=4), fixed(LOWEST, 0.2499, 0.2501, HIGHEST)).tolist() == [1, 1, 2, 2]


def test_huge_and_infinite_logits_are_sampled() -> None:
    logits = np.array([[1e30, -np.inf, 1e30], [-np.inf, -3e38, -np.inf]], np.float32)
    assert sample(logits, Discrete(n=3), fixed(HIGHEST, LOWEST)).tolist() == [2, 1]


def test_each_row_draws_from_its_own_generator() -> None:
    assert draw(fixed(0.25, 0.75), 2).tolist() == [0.25, 0.75]
    assert draw(fixed(0.25, 0.75), 2, (2,)).tolist() == [[0.25, 0.25], [0.75, 0.75]]
    assert draw([], 0, (2,)).shape == (0, 2)
    with pytest.raises(InvalidInput, match="3 rows needs rng, one generator per row: got 2"):
        draw(fixed(0.25, 0.75), 3)


def test_each_element_of_an_action_has_its_own_distribution() -> None:
    logits = np.array([[0.0, -1e9, -1e9, 0.0, 0.0]] * 3, np.float32)
    space = MultiDiscrete(nvec=[2, 3], start=[0, 5], shape=(2,))
    assert sample(logits, space, fixed(LOWEST, 0.4999, 0.5)).tolist() == [[0, 1], [0, 1], [0, 2]]


def test_box_actions_are_normally_distributed() -> None:
    rows = 20_000
    inputs = np.tile(np.array([[3.0, -1.0, np.log(0.5), np.log(2.0)]], np.float32), (rows, 1))
    rng = [np.random.default_rng((7, row)) for row in range(rows)]
    raw = sample(inputs, Box(dtype="float32", shape=(2,), low=0, high=1), rng)
    assert (raw.shape, raw.dtype) == ((rows, 2), np.float32)
    np.testing.assert_allclose(raw.mean(0), [3.0, -1.0], atol=5 * 2 / rows**0.5)
    np.testing.assert_allclose(raw.std(0), [0.5, 2.0], rtol=5 / (2 * rows) ** 0.5)
    assert abs(np.corrcoef(raw.T)[0, 1]) < 5 / rows**0.5
    assert (sample(inputs[:5], Box(dtype="float32", shape=(2,), low=0, high=1), rng[:5]) != raw[:5]).all(), (
        "the generators advance"
    )
    again = [np.random.default_rng((7, row)) for row in range(3, 5)]
    assert (sample(inputs[3:5], Box(dtype="float32", shape=(2,), low=0, high=1), again) == raw[3:5]).all()


def test_an_unsupported_space_is_rejected() -> None:
    with pytest.raises(ConfigError, match="unsupported action space"):
        sample(np.zeros((1, 4), np.float32), MultiBinary(shape=(2,)), fixed(0.5))
