"""Observations as an environment gives them → the JSON of a request, arrays as their bytes.

| in the observation      | in the request                                                   |
|-------------------------|------------------------------------------------------------------|
| an array                | `{"b64": "…", "dtype": "int8", "shape": [6, 7, 2]}`              |
| an image, `png` wanted  | `{"png": "…"}`, or a list of them where one cannot hold all channels |
| a NumPy number          | a number                                                         |
| a dict                  | an object with the same keys                                     |
| anything else           | as it is                                                         |
"""

import io
from base64 import b64encode
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
import orjson
from numpy.typing import NDArray

from league.errors import InvalidInput

Encoding = Literal["base64", "png", "lists"]
"""How arrays are sent. base64: their bytes, which must be of the space's dtype. png: images (uint8, height × width, or
height × width × channels) as such, smaller and slower to make, the rest as base64. lists: as nested lists of numbers,
which the server converts to the space's dtype."""
CHANNELS = 4
"""What one PNG holds at most."""
FASTEST = 1
"""zlib's level: frames of a game compress well at any."""


def encoded(observation: Any, encoding: Encoding) -> Any:
    """What stands for an observation in a request."""
    if isinstance(observation, np.ndarray):
        return _array(observation, encoding)
    if isinstance(observation, Mapping):
        return {key: encoded(part, encoding) for key, part in observation.items()}
    return observation.item() if isinstance(observation, np.generic) else observation


def rows(observations: Any) -> list[Any]:
    """The observations of a batch: of a sequence, or of arrays whose first axis is the batch.

    Raises InvalidInput if the arrays are of different lengths.
    """
    if isinstance(observations, Mapping):
        parts = {key: rows(part) for key, part in observations.items()}
        lengths = {len(part) for part in parts.values()}
        if len(lengths) != 1:
            raise InvalidInput(f"the arrays of a batch have {sorted(lengths)} rows, expected the same of all")
        return [dict(zip(parts, row, strict=True)) for row in zip(*parts.values(), strict=True)]
    if isinstance(observations, (str, bytes)) or not isinstance(observations, (Sequence, np.ndarray)):
        kind = type(observations).__name__
        raise InvalidInput(
            f"a batch is {kind}, expected a list of observations, or arrays whose first axis is the batch"
        )
    return list(observations)


def to_json(document: Mapping[str, Any]) -> bytes:
    """The bytes of a request. Raises InvalidInput."""
    try:
        return orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
    except orjson.JSONEncodeError as error:
        raise InvalidInput(f"the observation cannot be sent: {error}") from error


def _array(array: NDArray, encoding: Encoding) -> Any:
    if array.dtype.kind not in "iufb":
        raise InvalidInput(f"an array of {array.dtype.name} cannot be sent, expected numbers")
    if encoding == "lists" or not array.ndim:
        return array.tolist()
    if encoding == "png" and array.dtype == np.uint8 and array.ndim in (2, 3) and array.size:
        return {"png": _png(array)}
    if array.dtype.str[0] == ">":
        array = array.astype(array.dtype.newbyteorder("<"))
    return {"b64": b64encode(array.tobytes()).decode(), "dtype": array.dtype.name, "shape": array.shape}


def _png(image: NDArray) -> str | list[str]:
    """One PNG, or several that share the channels."""
    if image.ndim == 2:
        return _one_png(image)
    parts = [image[..., first : first + CHANNELS] for first in range(0, image.shape[2], CHANNELS)]
    return _one_png(parts[0]) if len(parts) == 1 else [_one_png(part) for part in parts]


def _one_png(image: NDArray) -> str:
    from PIL import Image

    file = io.BytesIO()
    flat = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    Image.fromarray(np.ascontiguousarray(flat)).save(file, "PNG", compress_level=FASTEST)
    return b64encode(file.getbuffer()).decode()
