import numpy as np
import pytest
from gymnasium import spaces as gym
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from league.errors import EnvironmentMismatch, IllegalMask, ObservationError
from league.spaces import Space, inputs
from league.spaces.arrays import check, check_mask, environment_actions, nested, tensors
from league.spaces.conversion import from_gymnasium, to_gymnasium

MASKED = gym.Dict({"action_mask": gym.Box(0, 1, (7,), np.int8), "observation": gym.Box(0, 1, (6, 7, 2), np.int8)})


EXAMPLES = [
    MASKED,
    gym.Box(-np.inf, np.inf, (18,), np.float32),
    gym.Box(np.array([0.0, -1.0], np.float32), np.array([np.inf, 1.0], np.float32)),
    gym.Box(0, 255, (84, 84, 4), np.uint8),
    gym.Discrete(4),
    gym.Discrete(5, start=-2),
    gym.MultiDiscrete([3, 4, 5]),
    gym.MultiDiscrete([[2, 3], [4, 5]]),
    gym.MultiBinary(6),
    gym.Dict({"lidar": gym.Box(0, 1, (3,)), "pose": gym.Dict({"x": gym.Box(0, 1, ()), "gear": gym.Discrete(5)})}),
]


def test_inputs_have_the_names_of_the_graph() -> None:
    assert list(inputs(from_gymnasium(MASKED))) == ["observation", "action_mask"]
    assert list(inputs(from_gymnasium(gym.Discrete(3)))) == ["observation"]
    assert list(inputs(from_gymnasium(EXAMPLES[-1]))) == [
        "observation.lidar",
        "observation.pose.gear",
        "observation.pose.x",
    ]


BOARD = inputs(from_gymnasium(MASKED))["observation"]


POSE = inputs(from_gymnasium(gym.Box(-1, 1, (2,))))["observation"]


def test_an_array_that_does_not_fit_is_rejected(subtests: pytest.Subtests) -> None:
    for array, leaf, message in (
        (np.zeros((1, 6, 7)), BOARD, r"shape \[6, 7\], expected \[6, 7, 2\]"),
        (np.full((1, 6, 7, 2), 0.5), BOARD, "fractions"),
        (np.full((1, 6, 7, 2), np.nan), BOARD, "NaN"),
        (np.full((1, 6, 7, 2), 300), BOARD, "between -128 and 127"),
        (np.full((1, 6, 7, 2), "x"), BOARD, "other than numbers"),
        (np.array([[np.nan, 0.0]]), POSE, "NaN or infinity"),
        (np.array([[1e39, 0.0]]), POSE, "NaN or infinity"),
        (np.array([4]), from_gymnasium(gym.Discrete(4)), "between 0 and 3"),
        (np.array([[0, 3]]), from_gymnasium(gym.MultiDiscrete([2, 3])), "between"),
        (np.array([[2]]), from_gymnasium(gym.MultiBinary(1)), "between 0 and 1"),
    ):
        with subtests.test(message=message), pytest.raises(ObservationError, match=message):
            check("observation", array, leaf)
    for mask, message in (([[1, 2]], "other than 0 and 1"), ([[1, -1]], "other than"), ([[1, 0], [0, 0]], "no action")):
        with subtests.test(mask=mask), pytest.raises(IllegalMask, match=message):
            check_mask(np.array(mask, np.int8))


def test_environments_get_actions_as_sample_returns_them() -> None:
    for space in (
        gym.Discrete(3, start=2),
        gym.Discrete(3, dtype=np.int32),
        gym.MultiDiscrete([2, 3]),
        gym.Box(-1, 1, (), np.float32),
        gym.Box(-1, 1, (1,), np.float64),
    ):
        samples = [space.sample() for _ in range(3)]
        actions = environment_actions(np.array(samples), from_gymnasium(space))
        for action, sample in zip(actions, samples, strict=True):
            assert type(action) is type(sample)
            assert (action.dtype, action.shape) == (sample.dtype, sample.shape)
            assert np.array_equal(action, sample)


def test_spaces_that_cannot_be_learnt_are_refused_with_the_reason(subtests: pytest.Subtests) -> None:
    colliding = gym.Dict({"a.b": gym.Discrete(2), "a": gym.Dict({"b": gym.Discrete(2)})})
    for space, reason in (
        (gym.Box(-1, 1, (0,)), "has no elements: expected at least one"),
        (gym.Dict({"a": gym.Box(-1, 1, (2, 0))}), "has no elements"),
        (gym.Dict({}), "a Dict without keys is not supported"),
        (gym.Discrete(10**6), "has 1,000,000 choices: expected at most 65,536"),
        (gym.MultiDiscrete([40_000, 40_000]), "has 80,000 choices"),
        (colliding, "would have the name 'observation.a.b'"),
        (gym.Dict({1: gym.Discrete(2)}), "a Dict has the key 1: expected a string"),
        (gym.Tuple([gym.Discrete(2)]), "is not supported: expected Box, Discrete"),
        (gym.Text(5), "Text"),
    ):
        with subtests.test(reason=reason), pytest.raises(EnvironmentMismatch, match=reason):
            from_gymnasium(space)


@given(st.integers(-128, 127))
def test_integers_are_accepted_in_any_dtype(value: int) -> None:
    for dtype in (np.int64, np.float64, np.int16):
        checked = check("observation", np.full((3, 6, 7, 2), value, dtype), BOARD)
        assert checked.dtype == np.int8
        assert (checked == value).all()


def test_nested_values_are_the_inverse_of_tensors() -> None:
    space = gym.Dict({"a.b": gym.Discrete(2), "a": gym.Dict({"c": gym.Box(-1, 1, (2,)), "": gym.MultiBinary(2)})})
    value = space.sample()
    again = nested(from_gymnasium(space), tensors(from_gymnasium(space), value))
    np.testing.assert_equal(again, {key: dict(part) if isinstance(part, dict) else part for key, part in value.items()})


def test_spaces_survive_json_and_their_samples_are_valid(subtests: pytest.Subtests) -> None:
    adapter: TypeAdapter[Space] = TypeAdapter(Space)
    for space in EXAMPLES:
        with subtests.test(space=str(space)):
            space.seed(7)
            converted = from_gymnasium(space)
            assert adapter.validate_json(adapter.dump_json(converted)) == converted
            assert to_gymnasium(converted) == space
            leaves, arrays = inputs(converted), tensors(converted, space.sample())
            assert list(arrays) == list(leaves)
            for name, array in arrays.items():
                assert check(name, array[None], leaves[name]).dtype == leaves[name].dtype
