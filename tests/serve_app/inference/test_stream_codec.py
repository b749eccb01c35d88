"""Binary messages: they survive encoding, and invalid ones are rejected."""

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from league.errors import InvalidInput, ObservationError
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.inference.stream_codec import HAS_RESETS, REQUEST, RESPONSE, BinaryCodec, encode_request, parse_request
from serve_app.live_versions.version_cache import ActionSelections, LoadedPolicy, load
from tests.support.leagues.protocol_leagues import DTYPES, every_kind

MAX_ROWS = 64
"""Maximum number of rows in a message."""


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, LoadedPolicy]:
    registry = every_kind(Storage.at(tmp_path_factory.mktemp("framing")))
    loaded = {league: policy(registry, league) for league in ("kinds", "board", "vector", "chess", "memory")}
    registry.close()
    return loaded


def policy(registry: Registry, league: str) -> LoadedPolicy:
    return load(registry, league, 1, inline=1, selections=ActionSelections()).policy(None)


def leaves(dtype: str, rows: int) -> st.SearchStrategy[np.ndarray]:
    """Arrays of any bytes, without NaN and infinity: requests may contain neither."""
    shape, kind = (rows, 2, 3), np.dtype(dtype)
    size = int(np.prod(shape)) * kind.itemsize

    def array(content: bytes) -> np.ndarray:
        if kind.kind == "b":
            return (np.frombuffer(content, np.uint8) & 1).astype(bool).reshape(shape)
        values = np.frombuffer(content, kind).reshape(shape)
        return np.where(np.isfinite(values), values, kind.type(0)) if kind.kind == "f" else values

    return st.binary(min_size=size, max_size=size).map(array)


@st.composite
def request_data(draw: st.DrawFn) -> dict[str, Any]:
    rows = draw(st.integers(1, 3))
    return {
        "rows": rows,
        "seed": draw(st.none() | st.integers(0, 2**63 - 1)),
        "explore": draw(st.none() | st.booleans()),
        "reset": draw(st.booleans()),
        "tensors": [draw(leaves(dtype, rows)) for dtype in DTYPES],
    }


@settings(max_examples=50)
@given(data=request_data(), has_resets=st.booleans())
def test_requests_survive_encoding(policies: dict[str, LoadedPolicy], data: dict[str, Any], has_resets: bool) -> None:
    codec = BinaryCodec(policies["kinds"])
    names = [name for name, *_ in policies["kinds"].reader.leaves]
    assert names == [tensor.name for tensor in policies["kinds"].manifest.inputs]
    by_dtype = dict(zip(DTYPES, data["tensors"], strict=True))
    tensors = [by_dtype[name.removeprefix("observation.")] for name in names]
    message = encode_request(**(data | {"tensors": tensors}))
    if has_resets:  # makes the tensors unaligned
        message = bytes((1, message[1] | HAS_RESETS)) + message[2:16] + bytes(data["rows"]) + message[16:]
    read = parse_request(message, MAX_ROWS)
    assert {name: getattr(read, name) for name in data.keys() - {"tensors"}}.items() <= data.items()
    assert (read.resets is not None) == has_resets
    found = codec.read(read)
    assert list(found) == names
    for name, tensor in zip(names, tensors, strict=True):
        np.testing.assert_array_equal(found[name], tensor)
        assert found[name].dtype == tensor.dtype
        assert found[name].flags.aligned


@given(resets=st.lists(st.booleans(), min_size=1, max_size=MAX_ROWS))
def test_resets_are_parsed(policies: dict[str, LoadedPolicy], resets: list[bool]) -> None:
    rows = len(resets)
    observation = np.arange(rows, dtype="<f4").reshape(rows, 1)
    message = REQUEST.pack(1, HAS_RESETS, 0, rows, 0) + bytes(resets) + observation.tobytes()
    read = parse_request(message, MAX_ROWS)
    assert read.resets is not None
    assert read.resets.tolist() == resets
    np.testing.assert_array_equal(BinaryCodec(policies["memory"]).read(read)["observation"], observation)


@given(rows=st.integers(1, MAX_ROWS), version=st.integers(1, 2**32 - 1), data=st.data())
def test_replies_contain_the_actions(
    policies: dict[str, LoadedPolicy], rows: int, version: int, data: st.DataObject
) -> None:
    for league, dtype, shape in (("board", "<i8", (rows,)), ("vector", "<f4", (rows, 2))):
        numbers = {"allow_nan": False} if dtype == "<f4" else {}
        actions = data.draw(
            arrays.arrays(np.dtype(dtype), shape, elements=arrays.from_dtype(np.dtype(dtype), **numbers))
        )
        reply = BinaryCodec(policies[league]).write(actions, version)
        assert RESPONSE.unpack_from(reply) == (1, 0, 0, rows, version, 0)
        np.testing.assert_array_equal(np.frombuffer(reply, dtype, offset=16).reshape(shape), actions)


def test_a_header_has_the_documented_layout() -> None:
    message = encode_request([np.array([1, 2], "<u2")], 2, seed=0x0102030405060708, explore=True, reset=True)
    assert message.hex(" ") == "01 07 00 00 02 00 00 00 08 07 06 05 04 03 02 01 01 00 02 00"


def test_bytes_of_a_boolean_are_0_and_1(policies: dict[str, LoadedPolicy]) -> None:
    planes, mask = np.zeros((1, 8, 8, 111), np.uint8), np.ones((1, 4672), np.int8)
    codec = BinaryCodec(policies["chess"])
    codec.read(parse_request(encode_request([planes, mask], 1), MAX_ROWS))
    planes[0, 3, 3, 3] = 2
    with pytest.raises(ObservationError, match="other than 0 and 1"):
        codec.read(parse_request(encode_request([planes, mask], 1), MAX_ROWS))


@given(message=st.binary(max_size=200) | st.binary(max_size=184).map(lambda rest: REQUEST.pack(1, 0, 0, 1, 0) + rest))
def test_any_bytes_are_parsed_or_rejected(policies: dict[str, LoadedPolicy], message: bytes) -> None:
    for each in policies.values():
        with suppress(InvalidInput):
            request = parse_request(message, MAX_ROWS)
            found = BinaryCodec(each).read(request)
            assert {len(array) for array in found.values()} == {request.rows}
