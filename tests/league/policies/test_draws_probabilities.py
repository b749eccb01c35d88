"""Reported probabilities are those of the drawn actions."""

import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from league.errors import ConfigError
from league.policies.actions import to_environment
from league.policies.draws import certain, probabilities, sample
from league.spaces import Box, DictSpace, Discrete, MultiDiscrete, Space

logits = arrays(np.float32, (3, 5), elements=st.floats(-1e9, 1e9, width=32))
PAIRS = MultiDiscrete(nvec=[[2, 3]], start=[[0, 1]], shape=(1, 2))
MIXED = Box(dtype="float32", shape=(2, 2), low=[[-1.0, 0.0], [None, None]], high=[[3.0, None], [5.0, None]])


def test_discrete_probabilities_are_a_softmax() -> None:
    found = probabilities(np.log(np.array([[1.0, 2.0, 5.0]], np.float32)), Discrete(n=3, start=-1))
    assert found == [pytest.approx([0.125, 0.25, 0.625])]


@given(inputs=logits, mask=arrays(np.int8, (3, 5), elements=st.integers(0, 1)))
def test_probabilities_sum_to_one_and_are_zero_for_illegal_actions(inputs: np.ndarray, mask: np.ndarray) -> None:
    mask[:, 2] = 1
    found = np.array(probabilities(inputs, Discrete(n=5), mask))
    assert found.sum(axis=1) == pytest.approx(np.ones(3))
    assert not found[mask == 0].any()
    assert (found >= 0).all()


def test_large_logits_of_illegal_actions_are_masked() -> None:
    """A graph may leave masking to the server: the largest logit may belong to an illegal action."""
    found = probabilities(np.array([[1e6, 0.0, 0.0]], np.float32), Discrete(n=3), np.array([[0, 1, 1]]))
    assert found == [[0.0, 0.5, 0.5]]


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


def test_an_unsupported_space_is_rejected() -> None:
    with pytest.raises(ConfigError, match="unsupported action space"):
        probabilities(np.zeros((1, 2), np.float32), DictSpace(spaces={"a": Discrete(n=2)}))
    with pytest.raises(ConfigError, match="unsupported action space"):
        certain(np.zeros(1), DictSpace(spaces={"a": Discrete(n=2)}))
