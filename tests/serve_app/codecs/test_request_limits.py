import base64
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from league.errors import BodyTooLarge
from league.spaces import Box
from serve_app.codecs.request_limits import LARGE_BODY, OVERHEAD_SIZE, RequestLimits

MAX_BATCH = 64
SHAPES = st.lists(st.lists(st.integers(1, 6), max_size=4).map(tuple), min_size=1, max_size=3)
NUMBERS = st.sampled_from([0.0, 1.0, -1.7976931348623157e308, 5e-324])
INDENTS = st.sampled_from([None, 1])


def limits_of(shapes: list[tuple[int, ...]]) -> RequestLimits:
    return RequestLimits.of([Box(dtype="float64", shape=shape, low=None, high=None) for shape in shapes])


@st.composite
def requests(draw: st.DrawFn) -> tuple[RequestLimits, int, bytes]:
    """The limits of a space, and a valid request: its number of observations and its body."""
    shapes, rows, indent = draw(SHAPES), draw(st.integers(1, MAX_BATCH)), draw(INDENTS)
    number, encode = draw(NUMBERS), draw(st.sampled_from([lambda leaf: leaf.tolist(), _base64]))
    observation = {f"leaf{index}": encode(np.full(shape, number)) for index, shape in enumerate(shapes)}
    document = {"observations": [observation] * rows, "seed": [2**63 - 1] * rows, "explore": True}
    return limits_of(shapes), rows, json.dumps(document, indent=indent).encode()


def _base64(leaf: NDArray) -> dict[str, Any]:
    return {"b64": base64.b64encode(leaf.tobytes()).decode(), "dtype": "float64", "shape": list(leaf.shape)}


@given(requests())
def test_valid_requests_are_within_the_limits(request: tuple[RequestLimits, int, bytes]) -> None:
    limits, rows, body = request
    limits.check_size(len(body), rows)
    limits.check_body(body, MAX_BATCH)
    limits.check_body(memoryview(body), MAX_BATCH)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (b"[],", "lists and objects, expected at most"),
        (b"[[1]],", "lists and objects, expected at most"),
        (b"{},", "lists and objects, expected at most"),
        (b"1,", "commas, expected at most"),
        (b"1.000000000000000000,", "commas, expected at most"),
    ],
)
def test_bodies_that_are_expensive_to_parse_are_rejected(part: bytes, message: str) -> None:
    """Half a megabyte, for a policy with four numbers in a list."""
    with pytest.raises(BodyTooLarge, match=message):
        limits_of([(4,)]).check_body(b"[" + part * (2**19 // len(part)), 1024)


def test_the_size_is_limited_by_the_number_of_observations() -> None:
    limits = limits_of([(4,)])
    limits.check_size(OVERHEAD_SIZE + limits.size, 1)
    with pytest.raises(BodyTooLarge, match=r"the body has \d+ bytes, expected at most \d+ for 1 observations"):
        limits.check_size(OVERHEAD_SIZE + limits.size + 1, 1)
    limits.check_size(OVERHEAD_SIZE + limits.size + 1, 2)
    with pytest.raises(BodyTooLarge, match=r"expected at most \d+ for 8 observations"):
        limits.check_body(b" " * 4 * LARGE_BODY, 8)
