"""Binary messages: whatever a policy takes goes in as it was, and what does not fit is refused."""

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from league.errors import InvalidInput, ObservationError
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.loading import LoadedPolicy, load
from serve_app.stream_framing import HAS_RESETS, REPLY, REQUEST, Framing, read_head, request
from tests.serve_app.inference_protocol.leagues import DTYPES, every_kind

MOST = 64
"""Rows of a message."""


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, LoadedPolicy]:
    registry = every_kind(Storage.at(tmp_path_factory.mktemp("framing")))
    loaded = {league: policy(registry, league) for league in ("kinds", "board", "vector", "chess", "memory")}
    registry.close()
    return loaded


def policy(registry: Registry, league: str) -> LoadedPolicy:
    return load(registry, league, 1, inline=1).policy(None)


def leaves(dtype: str, rows: int) -> st.SearchStrategy[np.ndarray]:
    """Arrays that a request may hold: no NaN, no infinity."""
    finite = {"allow_nan": False, "allow_infinity": False} if np.dtype(dtype).kind == "f" else {}
    return arrays.arrays(np.dtype(dtype), (rows, 2, 3), elements=arrays.from_dtype(np.dtype(dtype), **finite))


@st.composite
def asks(draw: st.DrawFn) -> dict[str, Any]:
    rows = draw(st.integers(1, 5))
    return {
        "rows": rows,
        "seed": draw(st.none() | st.integers(0, 2**63 - 1)),
        "explore": draw(st.booleans()),
        "reset": draw(st.booleans()),
        "tensors": [draw(leaves(dtype, rows)) for dtype in DTYPES],
    }


@given(ask=asks(), has_resets=st.booleans())
def test_what_is_written_is_read(policies: dict[str, LoadedPolicy], ask: dict[str, Any], has_resets: bool) -> None:
    framing = Framing(policies["kinds"])
    names = [name for name, *_ in policies["kinds"].reader.leaves]
    assert names == [tensor.name for tensor in policies["kinds"].manifest.inputs]
    by_dtype = dict(zip(DTYPES, ask["tensors"], strict=True))
    tensors = [by_dtype[name.removeprefix("observation.")] for name in names]
    message = request(**(ask | {"tensors": tensors}))
    if has_resets:  # an odd number of bytes, after which nothing is aligned
        message = bytes((1, message[1] | HAS_RESETS)) + message[2:16] + bytes(ask["rows"]) + message[16:]
    read = read_head(message, MOST)
    assert {name: getattr(read, name) for name in ask.keys() - {"tensors"}}.items() <= ask.items()
    assert (read.resets is not None) == has_resets
    found = framing.read(read)
    assert list(found) == names
    for name, tensor in zip(names, tensors, strict=True):
        np.testing.assert_array_equal(found[name], tensor)
        assert found[name].dtype == tensor.dtype
        assert found[name].flags.aligned


@given(resets=st.lists(st.booleans(), min_size=1, max_size=MOST))
def test_episodes_begin_where_it_is_said(policies: dict[str, LoadedPolicy], resets: list[bool]) -> None:
    rows = len(resets)
    observation = np.arange(rows, dtype="<f4").reshape(rows, 1)
    message = REQUEST.pack(1, HAS_RESETS, 0, rows, 0) + bytes(resets) + observation.tobytes()
    read = read_head(message, MOST)
    assert read.resets is not None
    assert read.resets.tolist() == resets
    np.testing.assert_array_equal(Framing(policies["memory"]).read(read)["observation"], observation)


@given(rows=st.integers(1, MOST), version=st.integers(1, 2**32 - 1), data=st.data())
def test_replies_hold_the_actions(
    policies: dict[str, LoadedPolicy], rows: int, version: int, data: st.DataObject
) -> None:
    for league, dtype, shape in (("board", "<i8", (rows,)), ("vector", "<f4", (rows, 2))):
        numbers = {"allow_nan": False} if dtype == "<f4" else {}
        actions = data.draw(
            arrays.arrays(np.dtype(dtype), shape, elements=arrays.from_dtype(np.dtype(dtype), **numbers))
        )
        reply = Framing(policies[league]).write(actions, version)
        assert REPLY.unpack_from(reply) == (1, 0, 0, rows, version, 0)
        np.testing.assert_array_equal(np.frombuffer(reply, dtype, offset=16).reshape(shape), actions)


def test_a_head_has_the_stated_layout() -> None:
    message = request([np.array([1, 2], "<u2")], 2, seed=0x0102030405060708, explore=True, reset=True)
    assert message.hex(" ") == "01 07 00 00 02 00 00 00 08 07 06 05 04 03 02 01 01 00 02 00"


def test_a_byte_that_is_no_bool_is_refused(policies: dict[str, LoadedPolicy]) -> None:
    planes, mask = np.zeros((1, 8, 8, 111), np.uint8), np.ones((1, 4672), np.int8)
    framing = Framing(policies["chess"])
    framing.read(read_head(request([planes, mask], 1), MOST))
    planes[0, 3, 3, 3] = 2
    with pytest.raises(ObservationError, match="other than 0 and 1"):
        framing.read(read_head(request([planes, mask], 1), MOST))


@given(message=st.binary(max_size=200) | st.binary(max_size=184).map(lambda rest: REQUEST.pack(1, 0, 0, 1, 0) + rest))
def test_any_bytes_are_read_or_refused(policies: dict[str, LoadedPolicy], message: bytes) -> None:
    for each in policies.values():
        with suppress(InvalidInput):
            ask = read_head(message, MOST)
            found = Framing(each).read(ask)
            assert {len(array) for array in found.values()} == {ask.rows}
