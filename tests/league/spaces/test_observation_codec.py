"""Observations encoded as JSON are decoded to the same arrays."""

from typing import Any

import numpy as np
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from league.errors import ObservationError
from league.spaces import Box, DictSpace, Discrete, MultiBinary, Space, observation_codec
from league.spaces.arrays import tensors
from league.spaces.observation_codec import ObservationReader, reject_strings

GRID = Box(dtype="uint8", shape=(2, 3), low=0, high=255)


SPEED = Box(dtype="float32", shape=(2,), low=None, high=None)


MASK = Box(dtype="int8", shape=(3,), low=0, high=1)


SPACES: dict[str, Space] = {
    "leaf": GRID,
    "masked": DictSpace(spaces={"action_mask": MASK, "observation": GRID}),
    "masked and nested": DictSpace(
        spaces={"observation": DictSpace(spaces={"grid": GRID, "speed": SPEED}), "action_mask": MASK}
    ),
    "nested": DictSpace(spaces={"a": DictSpace(spaces={"b": GRID, "c": Discrete(n=4)}), "d": MultiBinary(shape=(2,))}),
}


def values(space: Space) -> st.SearchStrategy[Any]:
    match space:
        case DictSpace():
            return st.fixed_dictionaries({key: values(part) for key, part in space.spaces.items()})
        case Discrete():
            return st.integers(space.start, space.start + space.n - 1)
        case MultiBinary():
            return arrays(np.int8, space.shape, elements=st.integers(0, 1))
        case Box(shape=(3,)):
            masks = arrays(np.int8, space.shape, elements=st.integers(0, 1))
            return masks.filter(lambda mask: mask.any())
        case Box(dtype="float32"):
            return arrays(np.float32, space.shape, elements=st.floats(width=32, allow_nan=False, allow_infinity=False))
    return arrays(space.dtype, space.shape)


@pytest.mark.parametrize("space", SPACES.values(), ids=SPACES)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_observations_survive_json(space: Space, data: st.DataObject) -> None:
    batch = data.draw(st.lists(values(space), min_size=1, max_size=3))
    document = orjson.loads(orjson.dumps(batch, option=orjson.OPT_SERIALIZE_NUMPY))
    decoded = ObservationReader(space).read(document)
    expected = [tensors(space, value) for value in batch]
    assert decoded.keys() == expected[0].keys()
    for name, array in decoded.items():
        assert array.dtype == expected[0][name].dtype
        np.testing.assert_array_equal(array, np.stack([row[name] for row in expected]))


def test_nested_strings_are_found() -> None:
    reject_strings({"a": [1, [2.5, None, {"b": True}]]})
    with pytest.raises(ObservationError, match="'deep'"):
        reject_strings({"a": [1, [2, {"b": "deep"}]]})


def test_zeros_are_valid_observations_and_keys_are_counted() -> None:
    for name, keys in {"leaf": 0, "masked": 2, "masked and nested": 4, "nested": 4}.items():
        reader = ObservationReader(SPACES[name])
        assert reader.keys == keys
        zeros = reader.zeros(2)
        assert {array.shape[0] for array in zeros.values()} == {2}
        assert zeros.get("action_mask", np.ones(1)).all()


NUMBERS = st.one_of(st.integers(0, 1), st.integers(-300, 300), st.booleans(), st.sampled_from([1.0, 0.5, 2**70, None]))


def result(reader: ObservationReader, rows: list[Any]) -> Any:
    """An array, with its data type, or an error message."""
    try:
        array = reader.read(rows, is_plain=True)["observation"]
    except ObservationError as error:
        return str(error)
    return array.dtype, array.tolist()


@pytest.mark.parametrize("dtype", ["int8", "uint8"])
@pytest.mark.parametrize("shape", [(), (2,), (2, 1)])
@given(data=st.data())
def test_numbers_of_one_byte_are_read_like_others(dtype: str, shape: tuple[int, ...], data: st.DataObject) -> None:
    reader = ObservationReader(Box(dtype=dtype, shape=shape, low=None, high=None))
    value: st.SearchStrategy[Any] = NUMBERS
    for size in reversed(shape):
        value = st.lists(value, min_size=size, max_size=size) | st.lists(NUMBERS, max_size=3)
    rows = data.draw(st.lists(value, min_size=1, max_size=3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(observation_codec, "BYTES", ())
        expected = result(reader, rows)
    assert result(reader, rows) == expected


def test_decoded_arrays_are_not_taken_apart_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """For an image in base64 or PNG, that took seventy times as long as its decoding."""
    monkeypatch.setattr(observation_codec, "_bytes", lambda *_: pytest.fail("of lists only"))
    reader = ObservationReader(Box(dtype="uint8", shape=(2,), low=None, high=None))
    assert reader.read([{"b64": "AQI="}])["observation"].tolist() == [[1, 2]]
