"""Raw actions are mapped into their spaces."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from league.errors import ConfigError
from league.policies.actions import dist_inputs_size, from_environment, to_environment
from league.spaces import Box, DictSpace, Discrete, MultiBinary, MultiDiscrete, Space
from league.spaces.arrays import bounds
from league.spaces.conversion import from_gymnasium, to_gymnasium

PAIRS = MultiDiscrete(nvec=[[2, 3], [4, 5]], start=[[0, 1], [2, 3]], shape=(2, 2))


MIXED = Box(dtype="float32", shape=(2, 2), low=[[-1.0, 0.0], [None, None]], high=[[3.0, None], [5.0, None]])


def test_integers_start_at_the_start_of_their_space() -> None:
    assert to_environment(np.array([0, 2]), Discrete(n=5, start=-1)).tolist() == [-1, 1]
    raw = np.array([[0, 0, 0, 0], [1, 2, 3, 4]])
    actions = to_environment(raw, PAIRS)
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


@given(st.integers(0, 2**32 - 1), st.sampled_from([Discrete(n=5, start=-1), PAIRS, MIXED]))
def test_actions_of_the_environment_become_raw_actions(seed: int, space: Space) -> None:
    sampled = to_gymnasium(space)
    sampled.seed(seed)
    actions = np.stack([sampled.sample() for _ in range(3)])
    raw = from_environment(actions, space)
    assert raw.shape == ((3,) if isinstance(space, Discrete) else (3, 4))
    assert np.allclose(to_environment(raw, space), actions, atol=1e-5)


def test_the_size_of_the_distribution_inputs() -> None:
    number = Box(dtype="float64", shape=(), low=0, high=1)
    assert [dist_inputs_size(space) for space in (Discrete(n=5, start=2), PAIRS, MIXED, number)] == [5, 14, 8, 2]
    low, high = bounds(Box(dtype="float32", shape=(2, 3), low=None, high=1))
    assert (low == np.full((2, 3), -np.inf)).all()
    assert (high == np.ones((2, 3))).all()


def test_unsupported_action_spaces_are_rejected() -> None:
    integers, binary = Box(dtype="int8", shape=(2,), low=0, high=1), MultiBinary(shape=(2,))
    for space in (integers, binary, DictSpace(spaces={"move": Discrete(n=2)})):
        for use in (dist_inputs_size, lambda space: to_environment(np.zeros((1, 2)), space)):
            with pytest.raises(ConfigError, match="expected Discrete, MultiDiscrete or a Box of floats"):
                use(space)
