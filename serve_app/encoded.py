"""Leaves of an observation that came as base64: the bytes of an array, or PNG pictures.

    {"b64": "…", "dtype": "float32", "shape": [84, 84, 4]}     row-major, little-endian; dtype and shape may be left out
    {"png": "…"}                                               8 bits: grey, grey and alpha, RGB, or RGBA
    {"png": ["…", "…"]}                                        several, stacked along the last axis

Nothing is converted: an array has the dtype and the shape that the manifest says. How large a picture is stands in its
head, which is read before anything is decoded.
"""

import binascii
import struct
from collections.abc import Iterator, Sequence
from io import BytesIO
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from league.errors import BodyTooLarge, ObservationError
from league.spaces import Leaf

B64, PNG = "b64", "png"
ARRAY_KEYS = frozenset((B64, "dtype", "shape"))
SIGNATURE = b"\x89PNG\r\n\x1a\n"
CHUNK = struct.Struct(">I4s")
CRC = 4
HEADER = struct.Struct(">IIBBBBB")
"""Of IHDR: width, height, bits, colour type, compression, filter, interlacing."""
BODY = len(SIGNATURE) + CHUNK.size + HEADER.size + CRC
"""Where a picture's chunks begin, behind its head. A second head there could ask for another size."""
PIXELS = (b"IDAT", b"IEND")
"""The chunks that pixels need. Texts, profiles and frames of an animation may be compressed, too: they are not read."""
CHANNELS = {0: 1, 4: 2, 2: 3, 6: 4}
"""PNG's colour type → values of a pixel. 3 is a palette, whose indices are no values."""
MOST_PICTURES = 256
"""In one leaf."""
MOST_DECODED = 64 * 2**20
"""Bytes that the pictures of one request may decode to: a black one is a thousandth of that in the body."""


def is_encoded(value: Any) -> bool:
    """Whether a leaf came as base64."""
    return type(value) is dict and (B64 in value or PNG in value)


def refuse_large(name: str, rows: Sequence[Any], leaf: Leaf) -> None:
    """Raise BodyTooLarge if one leaf of a batch holds pictures that are too much together once they are decoded."""
    size = len(rows) * prod(leaf.shape)
    if size > MOST_DECODED and any(type(row) is dict and PNG in row for row in rows):
        raise BodyTooLarge(
            f"the pictures of {name} are {size} bytes when they are decoded, expected at most {MOST_DECODED}"
        )


def decode(name: str, value: dict[str, Any], leaf: Leaf) -> NDArray:
    """One leaf, `leaf.shape` in its dtype. Raises ObservationError, which names the leaf and what was expected."""
    return _array(name, value, leaf) if B64 in value else _pictures(name, value, leaf)


def _array(name: str, value: dict[str, Any], leaf: Leaf) -> NDArray:
    if not value.keys() <= ARRAY_KEYS:
        raise ObservationError(f"{name} has the unknown key {_odd(value, ARRAY_KEYS)!r}, expected b64, dtype and shape")
    dtype = value.get("dtype", leaf.dtype)
    if dtype != leaf.dtype:
        given = f"dtype {dtype[:64]!r}" if type(dtype) is str else "a dtype that is no string"
        raise ObservationError(f"{name} has {given}, expected {leaf.dtype}: nothing is converted")
    shape = value.get("shape", list(leaf.shape))
    if shape != list(leaf.shape):
        is_list = type(shape) is list and all(type(size) is int for size in shape)
        given = f"shape {shape[:16]}" if is_list else "a shape that is no list of integers"
        raise ObservationError(f"{name} has {given}, expected {list(leaf.shape)}")
    data = _bytes(f"{name}.b64", value[B64])
    size = prod(leaf.shape) * np.dtype(leaf.dtype).itemsize
    if len(data) != size:
        raise ObservationError(
            f"{name}.b64 holds {len(data)} bytes, expected {size}: {leaf.dtype} of shape {list(leaf.shape)}"
        )
    array = np.frombuffer(data, np.dtype(leaf.dtype).newbyteorder("<")).astype(leaf.dtype, copy=False)
    if array.dtype == bool and (array.view(np.uint8) > 1).any():
        raise ObservationError(f"{name}.b64 has bytes other than 0 and 1, expected bool")
    return array.reshape(leaf.shape)


def _pictures(name: str, value: dict[str, Any], leaf: Leaf) -> NDArray:
    if len(value) > 1:
        raise ObservationError(f"{name} has the unknown key {_odd(value, {PNG})!r}, expected png alone")
    if leaf.dtype != "uint8" or len(leaf.shape) not in (2, 3):
        raise ObservationError(f"{name} is {leaf.dtype} of shape {list(leaf.shape)}: no picture, which png would be")
    texts = value[PNG] if type(value[PNG]) is list else [value[PNG]]
    if not 1 <= len(texts) <= MOST_PICTURES:
        raise ObservationError(f"{name}.png holds {len(texts)} pictures, expected 1 to {MOST_PICTURES}")
    pictures = [_bytes(f"{name}.png", text) for text in texts]
    height, width, *channels = leaf.shape
    found = sum(_channels(name, picture, height, width) for picture in pictures)
    if found != (channels[0] if channels else 1):
        raise ObservationError(
            f"{name}.png has {found} values for each pixel, expected {channels[0] if channels else 1}"
            " (grey is 1, grey and alpha 2, RGB 3, RGBA 4; several pictures add up)"
        )
    decoded = [_decoded(name, picture, height, width) for picture in pictures]
    return (decoded[0] if len(decoded) == 1 else np.concatenate(decoded, axis=2)).reshape(leaf.shape)


def _channels(name: str, picture: bytes, height: int, width: int) -> int:
    """How many values a pixel has, by the picture's head, if that is as expected."""
    start = len(SIGNATURE) + CHUNK.size
    if not picture.startswith(SIGNATURE + CHUNK.pack(HEADER.size, b"IHDR")):
        raise ObservationError(f"{name}.png is no PNG")
    if len(picture) < BODY:
        raise ObservationError(f"{name}.png is cut off")
    found_width, found_height, bits, colour, *_ = HEADER.unpack_from(picture, start)
    if (found_height, found_width) != (height, width):
        raise ObservationError(
            f"{name}.png is {found_height} × {found_width} pixels (height × width), expected {height} × {width}"
        )
    if bits != 8 or colour not in CHANNELS:
        kind = "a palette" if colour == 3 else f"{bits} bits"
        raise ObservationError(f"{name}.png has {kind}, expected 8 bits of grey, grey and alpha, RGB, or RGBA")
    return CHANNELS[colour]


def _decoded(name: str, picture: bytes, height: int, width: int) -> NDArray:
    """Pixels, (height, width, values) uint8."""
    try:
        with Image.open(BytesIO(b"".join((picture[:BODY], *_pixel_chunks(picture)))), formats=("PNG",)) as image:
            return np.asarray(image).reshape(height, width, -1)
    except (OSError, SyntaxError, ValueError, struct.error, EOFError) as error:
        raise ObservationError(f"{name}.png cannot be decoded: {' '.join(str(error).split())[:200]}") from None


def _pixel_chunks(picture: bytes) -> Iterator[bytes]:
    at = BODY
    while at < len(picture):
        length, name = CHUNK.unpack_from(picture, at)
        end = at + CHUNK.size + length + CRC
        if name in PIXELS:
            yield picture[at:end]
        at = end


def _bytes(name: str, text: Any) -> bytes:
    if type(text) is not str:
        raise ObservationError(f"{name} is no string, expected base64")
    try:
        return binascii.a2b_base64(text, strict_mode=True)
    except (binascii.Error, ValueError) as error:  # ValueError: characters beyond ASCII
        raise ObservationError(f"{name} is no base64: {error}") from None


def _odd(value: dict[str, Any], known: Any) -> str:
    return min(value.keys() - known)[:64]
