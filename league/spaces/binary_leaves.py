"""Decodes observation leaves sent as base64: array bytes or PNG images.

    {"b64": "…", "dtype": "float32", "shape": [84, 84, 4]}     row-major, little-endian; dtype and shape are optional
    {"png": "…"}                                               8 bits: grey, grey and alpha, RGB, or RGBA
    {"png": ["…", "…"]}                                        several images, stacked along the last axis

Nothing is converted: dtype and shape must match the manifest. The size of an image is checked in its header before it
is decoded.
"""

import binascii
import struct
from collections.abc import Sequence
from io import BytesIO
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from league.errors import BodyTooLarge, ObservationError, one_line
from league.spaces import Leaf

B64, PNG = "b64", "png"
ARRAY_KEYS = frozenset((B64, "dtype", "shape"))
SIGNATURE = b"\x89PNG\r\n\x1a\n"
CHUNK = struct.Struct(">I4s")
CRC = 4
HEADER = struct.Struct(">IIBBBBB")
"""IHDR fields: width, height, bit depth, colour type, compression, filter, interlacing."""
BODY = len(SIGNATURE) + CHUNK.size + HEADER.size + CRC
"""Offset of the chunks after the header. A second header there could declare another size."""
PIXELS = (b"IDAT", b"IEND")
"""The chunks with pixel data. Other chunks (texts, profiles, animation frames) may be compressed and are not
decoded."""
CHANNELS = {0: 1, 4: 2, 2: 3, 6: 4}
"""PNG colour type → channels. Type 3 is a palette, whose indices are not pixel values."""
MAX_IMAGES = 256
"""Per leaf."""
MAX_DECODED_BYTES = 64 * 2**20
"""Size of the largest array of a request. Images are decoded up to it: a black one is a thousand times larger than its
encoding."""


def is_encoded(value: Any) -> bool:
    """Whether a leaf is base64."""
    return type(value) is dict and (B64 in value or PNG in value)


def check_decoded_size(name: str, rows: Sequence[Any], leaf: Leaf) -> None:
    """Raise BodyTooLarge if the images of one leaf of a batch are too large after decoding."""
    size = len(rows) * prod(leaf.shape)
    if size > MAX_DECODED_BYTES and any(type(row) is dict and PNG in row for row in rows):
        raise BodyTooLarge(f"the images of {name} decode to {size} bytes, expected at most {MAX_DECODED_BYTES}")


def decode(name: str, value: dict[str, Any], leaf: Leaf) -> NDArray:
    """Decode one leaf to an array of the leaf's shape and dtype. Raises ObservationError with the leaf's name."""
    return _decode_array(name, value, leaf) if B64 in value else _decode_images(name, value, leaf)


def little_endian(name: str, data: bytes | memoryview, dtype: np.dtype, type_name: str = "bool") -> NDArray:
    """The elements in bytes, (n,). Raises ObservationError for a boolean that is neither 0 nor 1.

    type_name: that of booleans in error messages.
    """
    array = np.frombuffer(data, dtype)
    if dtype.kind == "b" and (array.view(np.uint8) > 1).any():
        raise ObservationError(f"{name} has bytes other than 0 and 1, expected {type_name}")
    return array if array.flags.aligned else array.copy()  # kernels of a graph require alignment


def _decode_array(name: str, value: dict[str, Any], leaf: Leaf) -> NDArray:
    if not value.keys() <= ARRAY_KEYS:
        raise ObservationError(
            f"{name} has the unknown key {_unknown_key(value, ARRAY_KEYS)!r}, expected b64, dtype and shape"
        )
    dtype = value.get("dtype", leaf.dtype)
    if dtype != leaf.dtype:
        dtype_text = f"dtype {dtype[:64]!r}" if type(dtype) is str else "a dtype that is not a string"
        raise ObservationError(f"{name} has {dtype_text}, expected {leaf.dtype}: nothing is converted")
    shape = value.get("shape", list(leaf.shape))
    if shape != list(leaf.shape):
        is_list = type(shape) is list and all(type(size) is int for size in shape)
        shape_text = f"shape {shape[:16]}" if is_list else "a shape that is not a list of integers"
        raise ObservationError(f"{name} has {shape_text}, expected {list(leaf.shape)}")
    data = _decode_base64(f"{name}.b64", value[B64])
    size = prod(leaf.shape) * np.dtype(leaf.dtype).itemsize
    if len(data) != size:
        raise ObservationError(
            f"{name}.b64 holds {len(data)} bytes, expected {size}: {leaf.dtype} of shape {list(leaf.shape)}"
        )
    array = little_endian(f"{name}.b64", data, np.dtype(leaf.dtype).newbyteorder("<"))
    return array.astype(leaf.dtype, copy=False).reshape(leaf.shape)


def _decode_images(name: str, value: dict[str, Any], leaf: Leaf) -> NDArray:
    if len(value) > 1:
        raise ObservationError(f"{name} has the unknown key {_unknown_key(value, {PNG})!r}, expected png alone")
    if leaf.dtype != "uint8" or len(leaf.shape) not in (2, 3):
        raise ObservationError(f"{name} is {leaf.dtype} of shape {list(leaf.shape)}, which png cannot encode")
    texts = value[PNG] if type(value[PNG]) is list else [value[PNG]]
    if not 1 <= len(texts) <= MAX_IMAGES:
        raise ObservationError(f"{name}.png holds {len(texts)} images, expected 1 to {MAX_IMAGES}")
    pictures = [_decode_base64(f"{name}.png", text) for text in texts]
    height, width, *channels = leaf.shape
    channel_count = sum(_check_header(name, picture, height, width) for picture in pictures)
    if channel_count != (channels[0] if channels else 1):
        raise ObservationError(
            f"{name}.png has {channel_count} channels, expected {channels[0] if channels else 1}"
            " (grey has 1, grey and alpha 2, RGB 3, RGBA 4; several images add up)"
        )
    decoded = [_decode_pixels(name, picture, height, width) for picture in pictures]
    return (decoded[0] if len(decoded) == 1 else np.concatenate(decoded, axis=2)).reshape(leaf.shape)


def _check_header(name: str, picture: bytes, height: int, width: int) -> int:
    """Check the image header, and return the number of channels."""
    start = len(SIGNATURE) + CHUNK.size
    if not picture.startswith(SIGNATURE + CHUNK.pack(HEADER.size, b"IHDR")):
        raise ObservationError(f"{name}.png is not a PNG image")
    if len(picture) < BODY:
        raise ObservationError(f"{name}.png is truncated")
    found_width, found_height, bits, colour, *_ = HEADER.unpack_from(picture, start)
    if (found_height, found_width) != (height, width):
        raise ObservationError(
            f"{name}.png is {found_height} × {found_width} pixels (height × width), expected {height} × {width}"
        )
    if bits != 8 or colour not in CHANNELS:
        kind = "a palette" if colour == 3 else f"{bits} bits"
        raise ObservationError(f"{name}.png has {kind}, expected 8 bits of grey, grey and alpha, RGB, or RGBA")
    return CHANNELS[colour]


def _decode_pixels(name: str, picture: bytes, height: int, width: int) -> NDArray:
    """Pixels, (height, width, channels) uint8."""
    try:
        parts, at = [picture[:BODY]], BODY
        while at < len(picture):
            length, chunk = CHUNK.unpack_from(picture, at)
            end = at + CHUNK.size + length + CRC
            if chunk in PIXELS:
                parts.append(picture[at:end])
            at = end
        with Image.open(BytesIO(b"".join(parts)), formats=("PNG",)) as image:
            return np.asarray(image).reshape(height, width, -1)
    except (OSError, SyntaxError, ValueError, struct.error, EOFError) as error:
        raise ObservationError(f"{name}.png cannot be decoded: {one_line(error)[:200]}") from None


def _decode_base64(name: str, text: Any) -> bytes:
    if type(text) is not str:
        raise ObservationError(f"{name} is not a string, expected base64")
    try:
        return binascii.a2b_base64(text, strict_mode=True)
    except (binascii.Error, ValueError) as error:  # ValueError: characters beyond ASCII
        raise ObservationError(f"{name} is not valid base64: {error}") from None


def _unknown_key(value: dict[str, Any], known: Any) -> str:
    return min(value.keys() - known)[:64]
