"""Counting the fields of a message in its bytes."""

from typing import Any

import pytest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from league.errors import BodyTooLarge
from serve_app.access.errors import MalformedBody
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.inference_protocol.field_count import MAX_FIELDS, check_fields

REQUEST = messages.ModelInferRequest
Input = REQUEST.InferInputTensor
INPUTS, OUTPUTS, PARAMETERS, RAW, UNKNOWN, GROUP = b"\x2a\0", b"\x32\0", b"\x22\0", b"\x3a\0", b"\x78\1", b"\x0b\x0c"


def field(number: int, content: bytes) -> bytes:
    """A field with a length, as the wire format encodes it."""
    return REQUEST(raw_input_contents=[content]).SerializeToString().replace(b"\x3a", bytes([number << 3 | 2]), 1)


@pytest.mark.parametrize(
    "body",
    [
        *(MAX_FIELDS * part for part in (INPUTS, OUTPUTS, PARAMETERS, RAW, UNKNOWN, GROUP)),
        field(5, MAX_FIELDS * PARAMETERS),
        field(5, MAX_FIELDS * b"\x18\1"),  # dimensions
        field(5, field(5, MAX_FIELDS * b"\x42\0")),  # elements of bytes_contents
        field(5, field(5, MAX_FIELDS * b"\x18\1")),  # elements of int64_contents, not packed
        field(6, MAX_FIELDS * b"\x12\0"),
        field(4, field(2, MAX_FIELDS * b"\x10\1")),
    ],
)
def test_messages_with_many_fields_are_too_large(body: bytes) -> None:
    with pytest.raises(BodyTooLarge, match=f"more than {MAX_FIELDS} fields"):
        check_fields(body + UNKNOWN, REQUEST.DESCRIPTOR)


PADDING = field(3, bytes(MAX_FIELDS))


@pytest.mark.parametrize(
    "body",
    [
        PADDING + 11 * b"\xff",
        PADDING + b"\x2a",
        PADDING + b"\x2a\2\0",
        PADDING + b"\x0d\0",
        PADDING + b"\x09\0",
        PADDING + b"\x0f\0",
        PADDING + field(5, b"\x0a\7name"),
    ],
    ids=["integer", "length", "content", "32 bits", "64 bits", "wire type", "inner content"],
)
def test_messages_that_are_cut_off_are_malformed(body: bytes) -> None:
    with pytest.raises(DecodeError):
        REQUEST.FromString(body)
    with pytest.raises(MalformedBody, match="not a valid ModelInferRequest"):
        check_fields(body, REQUEST.DESCRIPTOR)


def test_a_large_message_with_few_fields_passes() -> None:
    contents = messages.InferTensorContents(int64_contents=[1] * 1_000_000)
    inputs = [Input(name="x", datatype="INT64", shape=[1000, 1000], contents=contents)]
    check_fields(REQUEST(model_name="m", inputs=inputs).SerializeToString(), REQUEST.DESCRIPTOR)
    check_fields(REQUEST(raw_input_contents=[bytes(4_000_000)]).SerializeToString(), REQUEST.DESCRIPTOR)


tensors = st.builds(
    Input,
    name=st.text(max_size=4),
    shape=st.lists(st.integers(-1, 2**62), max_size=3),
    parameters=st.dictionaries(st.text(max_size=2), st.builds(messages.InferParameter, int64_param=st.integers(0, 9))),
    contents=st.builds(messages.InferTensorContents, fp64_contents=st.lists(st.floats(), max_size=3)),
)
valid = st.builds(
    REQUEST,
    model_name=st.text(max_size=5),
    inputs=st.lists(tensors, max_size=3),
    raw_input_contents=st.lists(st.binary()),
)


@given(message=valid, damage=st.binary(max_size=8))
def test_no_message_that_the_parser_accepts_is_malformed(message: Any, damage: bytes) -> None:
    body = PADDING + message.SerializeToString() + damage
    try:
        REQUEST.FromString(body)
    except DecodeError:
        return
    check_fields(body, REQUEST.DESCRIPTOR)
