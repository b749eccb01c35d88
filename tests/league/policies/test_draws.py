"""Raw actions are mapped into their spaces; draws, also at the limits of the generator; reported probabilities."""

import warnings
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from league.errors import ConfigError, InvalidInput
from league.policies.actions import dist_inputs_size, from_environment, to_environment
from league.policies.draws import certain, choose, draw, probabilities, sample
from league.spaces import Box, DictSpace, Discrete, MultiBinary, MultiDiscrete, Space
from league.spaces.arrays import bounds
from league.spaces.conversion import from_gymnasium, to_gymnasium


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
        (reported,) = probabilities(inputs, MIXED)
    assert reported["mean"] == [pytest.approx([2.0, 2.0]), pytest.approx([-1.0, 7.0])]
    assert reported["std"] == [pytest.approx([2.0, 2.0]), pytest.approx([3.0, 0.5])]
    scalar = Box(dtype="float32", shape=(), low=0, high=10)
    assert probabilities(np.zeros((1, 2), np.float32), scalar) == [{"mean": 5.0, "std": 5.0}]


@pytest.mark.parametrize(
    ("space", "size"),
    [(Discrete(n=4, start=2), 4), (PAIRS, 5), (Box(dtype="float32", shape=(2,), low=-40, high=80), 4)],
)
def test_actions_are_drawn_with_the_reported_probabilities(space: Space, size: int) -> None:
    """Frequencies differ from the probabilities by at most five standard errors. Elements are independent."""
    rows = 8_000
    inputs = np.random.default_rng(1).normal(size=size).astype(np.float32)
    if isinstance(space, Box):
        inputs[2:] = -3.0  # avoids clipped draws
    generators = [np.random.default_rng(seed) for seed in range(rows)]
    drawn = to_environment(sample(np.tile(inputs, (rows, 1)), space, generators), space).reshape(rows, -1)
    assert isinstance(space, Discrete) or abs(np.corrcoef(drawn.T)[0, 1]) < 5 / rows**0.5
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
    (reported,) = probabilities(certain(action, MIXED), MIXED)
    assert reported == {"mean": [pytest.approx(row) for row in action[0].tolist()], "std": [[0, 0], [0, 0]]}
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


def test_probabilities_of_discrete_actions_are_a_softmax_of_the_legal_ones() -> None:
    softmax = probabilities(np.log(np.array([[1.0, 2.0, 5.0]], np.float32)), Discrete(n=3, start=-1))
    assert softmax == [pytest.approx([0.125, 0.25, 0.625])]
    # A graph may leave masking to the server: the largest logit may belong to an illegal action.
    masked = probabilities(np.array([[1e6, 0.0, 0.0]], np.float32), Discrete(n=3), np.array([[0, 1, 1]]))
    assert masked == [[0.0, 0.5, 0.5]]


FOUR = MultiDiscrete(nvec=[[2, 3], [4, 5]], start=[[0, 1], [2, 3]], shape=(2, 2))


def test_integers_start_at_the_start_of_their_space() -> None:
    assert to_environment(np.array([0, 2]), Discrete(n=5, start=-1)).tolist() == [-1, 1]
    raw = np.array([[0, 0, 0, 0], [1, 2, 3, 4]])
    actions = to_environment(raw, FOUR)
    assert actions.tolist() == [[[0, 1], [2, 3]], [[1, 3], [5, 7]]]
    assert actions.dtype == np.int64


def test_each_number_is_scaled_or_clipped_by_its_bounds() -> None:
    raw = np.array([[0.0, -2.0, 9.0, 100.0], [-1.0, 2.0, 4.0, -100.0], [7.0, 0.5, -8.0, 0.0]], np.float32)
    assert to_environment(raw, MIXED).tolist() == [
        [[1.0, 0.0], [5.0, 100.0]],
        [[-1.0, 2.0], [4.0, -100.0]],
        [[3.0, 0.5], [-8.0, 0.0]],
    ]


@given(
    arrays(np.float32, (3, 4), elements=st.floats(-1e6, 1e6, width=32)),
    st.sampled_from(["float16", "float32", "float64"]),
)
def test_actions_are_inside_their_space(raw: np.ndarray, dtype: str) -> None:
    largest = float(np.finfo(dtype).max)
    low, high = [[-largest, -0.1], [0.1, None]], [[largest, 0.3], [0.1, 7.0]]
    space = Box(dtype=dtype, shape=(2, 2), low=low, high=high)
    with np.errstate(over="ignore"):
        rounded = from_gymnasium(to_gymnasium(space))
    actions = to_environment(raw, rounded)
    assert actions.dtype == np.dtype(dtype)
    assert all(to_gymnasium(rounded).contains(action) for action in actions)


@given(st.integers(0, 2**32 - 1), st.sampled_from([Discrete(n=5, start=-1), FOUR, MIXED]))
def test_actions_of_the_environment_become_raw_actions(seed: int, space: Space) -> None:
    sampled = to_gymnasium(space)
    sampled.seed(seed)
    actions = np.stack([sampled.sample() for _ in range(3)])
    raw = from_environment(actions, space)
    assert raw.shape == ((3,) if isinstance(space, Discrete) else (3, 4))
    assert np.allclose(to_environment(raw, space), actions, atol=1e-5)


def test_the_size_of_the_distribution_inputs() -> None:
    number = Box(dtype="float64", shape=(), low=0, high=1)
    assert [dist_inputs_size(space) for space in (Discrete(n=5, start=2), FOUR, MIXED, number)] == [5, 14, 8, 2]
    low, high = bounds(Box(dtype="float32", shape=(2, 3), low=None, high=1))
    assert (low == np.full((2, 3), -np.inf)).all()
    assert (high == np.ones((2, 3))).all()


def test_unsupported_action_spaces_are_rejected() -> None:
    inputs, integers = np.zeros((1, 4), np.float32), Box(dtype="int8", shape=(2,), low=0, high=1)
    composite: list[Space] = [MultiBinary(shape=(2,)), DictSpace(spaces={"move": Discrete(n=2)})]
    remedy = ": expected Discrete, MultiDiscrete or a Box of floats$"
    uses: list[tuple[Callable[[Space], object], list[Space], str]] = [
        (dist_inputs_size, [integers, *composite], remedy),
        (lambda space: to_environment(np.zeros((1, 2)), space), [integers, *composite], remedy),
        (lambda space: sample(inputs, space, fixed(0.5)), composite, ""),
        (lambda space: probabilities(inputs, space), composite, ""),
        (lambda space: certain(inputs, space), composite, ""),
    ]
    for use, unsupported, ending in uses:
        for space in unsupported:
            with pytest.raises(ConfigError, match=f"unsupported action space .*{ending}"):
                use(space)
