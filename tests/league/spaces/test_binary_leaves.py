"""Leaves encoded as base64 or PNG are decoded to the same arrays, or rejected with a message at low cost."""

import struct
import zlib
from base64 import b64encode
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from PIL import PngImagePlugin

from league.errors import BodyTooLarge, ObservationError
from league.spaces import Box, Leaf
from league.spaces.binary_leaves import MAX_DECODED_BYTES, SIGNATURE, check_decoded_size, decode, is_encoded
from tests.support.examples import examples
from tests.support.pictures import MODES, png

DTYPES = [f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)] + [
    "bool",
    "float16",
    "float32",
    "float64",
]


def leaf(shape: tuple[int, ...], dtype: str = "uint8") -> Leaf:
    return Box(dtype=dtype, shape=shape, low=None, high=None)


def b64(data: bytes) -> str:
    return b64encode(data).decode()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def head(height: int, width: int, bits: int = 8, colour: int = 0, interlace: int = 0) -> bytes:
    return chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, interlace))


anything = st.sampled_from(DTYPES).flatmap(
    lambda dtype: arrays(dtype, array_shapes(min_dims=0, max_dims=3, max_side=4))
)


@given(array=anything, has_metadata=st.booleans())
@example(array=np.zeros((0, 2), np.float32), has_metadata=True)
def test_an_array_survives_encoding(array: NDArray, has_metadata: bool) -> None:
    value: dict[str, Any] = {"b64": b64(array.astype(array.dtype.newbyteorder("<")).tobytes())}
    if has_metadata:
        value |= {"dtype": array.dtype.name, "shape": list(array.shape)}
    assert is_encoded(value)
    read = decode("observation", value, leaf(array.shape, array.dtype.name))
    assert (read.dtype, read.shape) == (array.dtype, array.shape)
    assert read.tobytes() == array.tobytes()


def deep(depth: int) -> Any:
    """A nested list."""
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


EIGHT = b64(np.arange(2, dtype="<f4").tobytes())


BAD_ARRAYS: dict[str, tuple[dict[str, Any], str]] = {
    "another dtype": ({"b64": EIGHT, "dtype": "float64"}, "has dtype 'float64', expected float32"),
    "another order": ({"b64": EIGHT, "dtype": ">f4"}, "has dtype '>f4'"),
    "a deep dtype": ({"b64": EIGHT, "dtype": deep(1000)}, "not a string"),
    "another shape": ({"b64": EIGHT, "shape": [2, 1]}, "has shape [2, 1], expected [2]"),
    "a shape of strings": ({"b64": EIGHT, "shape": ["2"]}, "not a list of integers"),
    "a deep shape": ({"b64": EIGHT, "shape": deep(1000)}, "not a list of integers"),
    "too few bytes": ({"b64": b64(bytes(7))}, "holds 7 bytes, expected 8"),
    "not a string": ({"b64": [1]}, "not a string"),
    "not valid base64": ({"b64": "*" * 12}, "not valid base64"),
    "the alphabet of URLs": ({"b64": "__________8="}, "not valid base64"),
    "beyond ASCII": ({"b64": "ÄÄÄÄ"}, "not valid base64"),
    "an unknown key": ({"b64": EIGHT, "order": "C"}, "unknown key 'order'"),
}


GREY = np.arange(12, dtype=np.uint8).reshape(3, 4)


GOOD = png(GREY)


BAD_PICTURES: dict[str, tuple[Any, str]] = {
    "not valid base64": ("*", "not valid base64"),
    "not a string": (3, "not a string"),
    "a list of null": ([None], "not a string"),
    "none": ([], "holds 0 images"),
    "too many": ([b64(GOOD)] * 300, "holds 300 images, expected 1 to 256"),
    "a JPEG": (b64(b"\xff\xd8\xff\xe0" + bytes(64)), "is not a PNG image"),
    "only a signature": (b64(SIGNATURE), "is not a PNG image"),
    "half a head": (b64(GOOD[:20]), "truncated"),
    "another size": (b64(png(np.zeros((4, 3), np.uint8))), "4 × 3 pixels (height × width), expected 3 × 4"),
    "huge": (b64(SIGNATURE + head(2**31 - 1, 2**31 - 1)), "expected 3 × 4"),
    "RGB": (b64(png(np.zeros((3, 4, 3), np.uint8))), "3 channels, expected 1"),
    "16 bits": (b64(SIGNATURE + head(3, 4, bits=16)), "16 bits"),
    "a palette": (b64(SIGNATURE + head(3, 4, colour=3)), "a palette"),
    "no pixels": (b64(SIGNATURE + head(3, 4) + chunk(b"IEND", b"")), "cannot be decoded"),
    "pixels of another kind": (b64(GOOD.replace(b"IDAT", b"iDAT")), "cannot be decoded"),
    "damaged": (b64(GOOD.replace(head(3, 4), head(3, 4)[:-1] + b"\0")), "cannot be decoded"),
}


def test_the_decoded_size_of_images_is_limited() -> None:
    large = leaf((1024, 1024))
    rows: list[Any] = [{"png": ""}] * (MAX_DECODED_BYTES // 2**20)
    check_decoded_size("observation", rows, large)
    check_decoded_size("observation", [[0]] * 1000, large)
    with pytest.raises(BodyTooLarge, match="decode to"):
        check_decoded_size("observation", [*rows, [0]], large)


@examples(150)
@given(
    image=st.sampled_from([GOOD, png(np.zeros((3, 4, 4), np.uint8), compress_level=0)]),
    at=st.integers(0, 200),
    put=st.binary(max_size=8),
    cut=st.integers(0, 8),
)
def test_a_damaged_image_is_rejected_or_has_its_shape(image: bytes, at: int, put: bytes, cut: int) -> None:
    at %= len(image)
    damaged = image[:at] + put + image[at + cut :]
    for shape in ((3, 4), (3, 4, 4)):
        try:
            read = decode("observation", {"png": b64(damaged)}, leaf(shape))
        except ObservationError:
            continue
        assert (read.shape, read.dtype) == (shape, np.uint8)


@examples(100)
@given(
    chunks=st.lists(st.tuples(st.sampled_from([b"IHDR", b"IDAT", b"IEND", b"PLTE", b"tEXt"]), st.binary(max_size=30)))
)
def test_chunks_in_any_order_are_rejected_or_decoded(chunks: list[tuple[bytes, bytes]]) -> None:
    image = SIGNATURE + head(2, 2) + b"".join(chunk(*part) for part in chunks)
    with suppress(ObservationError):
        assert decode("observation", {"png": b64(image)}, leaf((2, 2))).shape == (2, 2)


def test_an_invalid_array_is_rejected(subtests: pytest.Subtests) -> None:
    for name, (value, message) in BAD_ARRAYS.items():
        with subtests.test(name):
            with pytest.raises(ObservationError) as error:
                decode("observation.speed", value, leaf((2,), "float32"))
            text = str(error.value)
            assert text.startswith("observation.speed")
            assert message in text
            assert len(text) < 300
    with pytest.raises(ObservationError, match="bytes other than 0 and 1"):
        decode("mask", {"b64": b64(b"\0\1\2")}, leaf((3,), "bool"))


@given(stack=st.lists(st.sampled_from(list(MODES)), min_size=1, max_size=5), data=st.data())
def test_images_survive_encoding_and_are_stacked_along_the_last_axis(stack: list[int], data: st.DataObject) -> None:
    height, width = data.draw(st.tuples(st.integers(1, 6), st.integers(1, 6)))
    parts = [data.draw(arrays(np.uint8, (height, width, values))) for values in stack]
    images = [b64(png(part)) for part in parts]
    read = decode("observation", {"png": images[0] if len(images) == 1 else images}, leaf((height, width, sum(stack))))
    assert (read.dtype, read.tolist()) == (np.uint8, np.concatenate(parts, axis=2).tolist())


def read_grey(image: bytes, shape: tuple[int, ...] = (3, 4)) -> Any:
    return decode("observation", {"png": b64(image)}, leaf(shape)).tolist()


def test_an_invalid_image_is_rejected(subtests: pytest.Subtests) -> None:
    for name, (value, message) in BAD_PICTURES.items():
        with subtests.test(name):
            with pytest.raises(ObservationError) as error:
                decode("observation.screen", {"png": value}, leaf((3, 4)))
            text = str(error.value)
            assert text.startswith("observation.screen")
            assert message in text
    for other in (leaf((3, 4), "float32"), leaf((12,)), leaf((3, 4, 1, 1)), leaf((), "uint8")):
        with pytest.raises(ObservationError, match="which png cannot encode"):
            decode("observation", {"png": b64(GOOD)}, other)
    with pytest.raises(ObservationError, match="unknown key 'shape'"):
        decode("observation", {"png": b64(GOOD), "shape": [3, 4]}, leaf((3, 4)))


def test_other_chunks_do_not_change_pixels() -> None:
    """Pillow decompresses texts and profiles, and rejects images with large ones. It uses the last header, which would
    allocate hundreds of megabytes or fail with its own error.
    """
    assert read_grey(GOOD) == GREY.tolist(), "no channel axis is needed"
    text = PngImagePlugin.PngInfo()
    text.add_text("comment", "x" * 50_000_000, zip=True)
    for image, extra in (
        (png(GREY, pnginfo=text), chunk(b"iCCP", b"x\0\0" + zlib.compress(bytes(50_000_000)))),
        (GOOD, chunk(b"tRNS", b"\0\1")),
        (GOOD, chunk(b"gAMA", struct.pack(">I", 1))),
        (GOOD, chunk(b"acTL", bytes(8))),
        (GOOD, head(12_000, 12_000)),
        (GOOD, head(60_000, 60_000)),
    ):
        end = image.index(b"IDAT") - 4
        assert read_grey(image[:end] + extra + image[end:]) == GREY.tolist()
    # Interlaced: one pixel is the first pass of Adam7 only.
    pixels = chunk(b"IDAT", zlib.compress(b"\0\x2a")) + chunk(b"IEND", b"")
    assert read_grey(SIGNATURE + head(1, 1, interlace=1) + pixels, (1, 1)) == [[42]]
