"""Draws at the limits of the random number generator, and reported probabilities, which are those of the draws."""

import warnings
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from league.errors import ConfigError, InvalidInput
from league.policies.actions import to_environment
from league.policies.draws import certain, choose, draw, probabilities, sample
from league.spaces import Box, DictSpace, Discrete, MultiBinary, MultiDiscrete, Space


class Fixed:
    """A generator that always returns the same number."""

    def __init__(self, number: float) -> None:
        self._number = number

    def random(self, shape: Any = None) -> Any:
        return self._number if shape is None else np.full(shape, self._number)


def fixed(*numbers: float) -> list[np.random.Generator]:
    return [cast(np.random.Generator, Fixed(number)) for number in numbers]


LOWEST, HIGHEST = 0.0, 1 - 2**-53


def test_each_row_draws_from_its_own_generator() -> None:
    assert draw(fixed(0.25, 0.75), 2).tolist() == [0.25, 0.75]
    assert draw(fixed(0.25, 0.75), 2, (2,)).tolist() == [[0.25, 0.25], [0.75, 0.75]]
    assert draw([], 0, (2,)).shape == (0, 2)
    with pytest.raises(InvalidInput, match="3 rows needs rng, one generator per row: got 2"):
        draw(fixed(0.25, 0.75), 3)


PAIRS = MultiDiscrete(nvec=[[2, 3]], start=[[0, 1]], shape=(1, 2))


MIXED = Box(dtype="float32", shape=(2, 2), low=[[-1.0, 0.0], [None, None]], high=[[3.0, None], [5.0, None]])


@given(
    inputs=arrays(np.float32, (3, 5), elements=st.floats(-1e9, 1e9, width=32)),
    mask=arrays(np.int8, (3, 5), elements=st.integers(0, 1)),
)
def test_probabilities_sum_to_one_and_are_zero_for_illegal_actions(inputs: np.ndarray, mask: np.ndarray) -> None:
    mask[:, 2] = 1
    reported = np.array(probabilities(inputs, Discrete(n=5), mask))
    assert reported.sum(axis=1) == pytest.approx(np.ones(3))
    assert not reported[mask == 0].any()
    assert (reported >= 0).all()


def test_each_element_has_its_own_probabilities() -> None:
    inputs = np.log(np.array([[1, 3, 1, 1, 2], [1, 1, 2, 1, 1]], np.float32))
    assert probabilities(inputs, PAIRS) == [
        [pytest.approx([0.25, 0.75]), pytest.approx([0.25, 0.25, 0.5])],
        [pytest.approx([0.5, 0.5]), pytest.approx([0.5, 0.25, 0.25])],
    ]
    mask = np.array([[1, 0, 1, 1, 0], [1, 1, 0, 0, 1]], np.int8)
    assert probabilities(inputs, PAIRS, mask) == [
        [pytest.approx([1.0, 0.0]), pytest.approx([0.5, 0.5, 0.0])],
        [pytest.approx([0.5, 0.5]), pytest.approx([0.0, 0.0, 1.0])],
    ]


def test_a_box_has_mean_and_deviation_in_its_own_units() -> None:
    inputs = np.array([[0.5, 2.0, -1.0, 7.0, *np.log([1.0, 2.0, 3.0, 0.5])]], np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (found,) = probabilities(inputs, MIXED)
    assert found["mean"] == [pytest.approx([2.0, 2.0]), pytest.approx([-1.0, 7.0])]
    assert found["std"] == [pytest.approx([2.0, 2.0]), pytest.approx([3.0, 0.5])]
    scalar = Box(dtype="float32", shape=(), low=0, high=10)
    assert probabilities(np.zeros((1, 2), np.float32), scalar) == [{"mean": 5.0, "std": 5.0}]


@pytest.mark.parametrize(
    ("space", "size"),
    [(Discrete(n=4, start=2), 4), (PAIRS, 5), (Box(dtype="float32", shape=(2,), low=-40, high=80), 4)],
)
def test_actions_are_drawn_with_the_reported_probabilities(space: Space, size: int) -> None:
    """Frequencies of 20,000 draws differ from the probabilities by at most five standard errors."""
    rows = 20_000
    inputs = np.random.default_rng(1).normal(size=size).astype(np.float32)
    if isinstance(space, Box):
        inputs[2:] = -3.0  # avoids clipped draws
    generators = [np.random.default_rng(seed) for seed in range(rows)]
    drawn = to_environment(sample(np.tile(inputs, (rows, 1)), space, generators), space).reshape(rows, -1)
    (computed,) = probabilities(inputs[None], space)
    for column, expected in zip(drawn.T, _marginals(computed, space), strict=True):
        if isinstance(space, Box):
            mean, deviation = expected
            assert abs(column.mean() - mean) < 5 * deviation / rows**0.5
            assert column.std() == pytest.approx(deviation, rel=0.05)
            continue
        counts = np.bincount(column - column.min(), minlength=len(expected)) / rows
        assert np.abs(counts - expected).max() < 5 * 0.5 / rows**0.5


def _marginals(reported: Any, space: Space) -> list[Any]:
    """The reported distribution of each element of an action."""
    if isinstance(space, Box):
        return list(zip(reported["mean"], reported["std"], strict=True))
    return [reported] if isinstance(space, Discrete) else list(reported)


def test_certain_actions_have_the_probability_one() -> None:
    assert probabilities(certain(np.array([1, -1]), space := Discrete(n=3, start=-1)), space) == [[0, 0, 1], [1, 0, 0]]
    assert probabilities(certain(np.array([[[1, 1]], [[0, 3]]]), PAIRS), PAIRS) == [
        [[0, 1], [1, 0, 0]],
        [[1, 0], [0, 0, 1]],
    ]
    action = np.array([[[2.0, -1.5], [-7.0, 3.0]]], np.float32)
    (found,) = probabilities(certain(action, MIXED), MIXED)
    assert found == {"mean": [pytest.approx(row) for row in action[0].tolist()], "std": [[0, 0], [0, 0]]}
    single = Box(dtype="float32", shape=(1,), low=2, high=2)
    assert probabilities(certain(np.full((1, 1), 2.0), single), single) == [{"mean": [2.0], "std": [0.0]}]


def test_extreme_random_numbers_draw_possible_actions() -> None:
    allowed = np.array([[0, 0, 1, 1, 0]] * 4, np.int8)
    assert choose(allowed, np.array([LOWEST, 0.4999, 0.5, HIGHEST])).tolist() == [2, 2, 3, 3]
    logits = np.array([[-1e9, 0.0, np.log(3.0), -1e9]] * 4, np.float32)
    assert sample(logits, Discrete(n=4), fixed(LOWEST, 0.2499, 0.2501, HIGHEST)).tolist() == [1, 1, 2, 2]
    huge = np.array([[1e30, -np.inf, 1e30], [-np.inf, -3e38, -np.inf]], np.float32)
    assert sample(huge, Discrete(n=3), fixed(HIGHEST, LOWEST)).tolist() == [2, 1]
    each_element = np.array([[0.0, -1e9, -1e9, 0.0, 0.0]] * 3, np.float32)
    space = MultiDiscrete(nvec=[2, 3], start=[0, 5], shape=(2,))
    assert sample(each_element, space, fixed(LOWEST, 0.4999, 0.5)).tolist() == [[0, 1], [0, 1], [0, 2]]


def test_box_actions_are_normally_distributed() -> None:
    rows, box = 20_000, Box(dtype="float32", shape=(2,), low=0, high=1)
    inputs = np.tile(np.array([[3.0, -1.0, np.log(0.5), np.log(2.0)]], np.float32), (rows, 1))
    rng = [np.random.default_rng((7, row)) for row in range(rows)]
    raw = sample(inputs, box, rng)
    assert (raw.shape, raw.dtype) == ((rows, 2), np.float32)
    np.testing.assert_allclose(raw.mean(0), [3.0, -1.0], atol=5 * 2 / rows**0.5)
    np.testing.assert_allclose(raw.std(0), [0.5, 2.0], rtol=5 / (2 * rows) ** 0.5)
    assert abs(np.corrcoef(raw.T)[0, 1]) < 5 / rows**0.5
    assert (sample(inputs[:5], box, rng[:5]) != raw[:5]).all(), "the generators advance"
    again = [np.random.default_rng((7, row)) for row in range(3, 5)]
    assert (sample(inputs[3:5], box, again) == raw[3:5]).all()


def test_an_unsupported_space_is_rejected() -> None:
    inputs, space = np.zeros((1, 4), np.float32), DictSpace(spaces={"a": Discrete(n=2)})
    for draw_from in (
        lambda: sample(inputs, MultiBinary(shape=(2,)), fixed(0.5)),
        lambda: probabilities(inputs, space),
        lambda: certain(inputs, space),
    ):
        with pytest.raises(ConfigError, match="unsupported action space"):
            draw_from()


def test_probabilities_of_discrete_actions_are_a_softmax_of_the_legal_ones() -> None:
    softmax = probabilities(np.log(np.array([[1.0, 2.0, 5.0]], np.float32)), Discrete(n=3, start=-1))
    assert softmax == [pytest.approx([0.125, 0.25, 0.625])]
    # A graph may leave masking to the server: the largest logit may belong to an illegal action.
    masked = probabilities(np.array([[1e6, 0.0, 0.0]], np.float32), Discrete(n=3), np.array([[0, 1, 1]]))
    assert masked == [[0.0, 0.5, 0.5]]
