"""Bodies of action requests: encodes observations as JSON.

| observation               | JSON                                                          |
|---------------------------|---------------------------------------------------------------|
| array                     | `{"b64": "…", "dtype": "int8", "shape": [6, 7, 2]}`           |
| image, with encoding png  | `{"png": "…"}`, or a list of these for more than 4 channels   |
| NumPy number              | number                                                        |
| dict                      | object with the same keys                                     |
| anything else             | unchanged                                                     |
"""

import io
import random
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
import orjson
from numpy.typing import NDArray

from policy_league_client.errors import InvalidInput

Encoding = Literal["base64", "png", "lists"]
"""Encoding of arrays in requests.

base64: raw bytes; the dtype must be that of the space.
png: images (uint8, (height, width) or (height, width, channels)) as PNG, which is smaller and slower; others as base64.
lists: nested lists of numbers, which the server converts to the dtype of the space.
"""
PNG_CHANNELS = 4
"""Maximum number of channels in a PNG."""
PNG_COMPRESSION = 1
"""zlib level. Frames of games compress well even at the fastest level."""

JsonObject = dict[str, Any]


def encode(observation: Any, encoding: Encoding) -> Any:
    """Return the JSON value of an observation."""
    if isinstance(observation, np.ndarray):
        return _encode_array(observation, encoding)
    if isinstance(observation, Mapping):
        return {key: encode(part, encoding) for key, part in observation.items()}
    return observation.item() if isinstance(observation, np.generic) else observation


def split_batch(observations: Any) -> list[Any]:
    """Return the observations of a batch: a sequence, or arrays whose first axis is the batch.

    Raises InvalidInput if the lengths of the arrays differ.
    """
    if isinstance(observations, Mapping):
        parts = {key: split_batch(part) for key, part in observations.items()}
        lengths = {len(part) for part in parts.values()}
        if len(lengths) != 1:
            raise InvalidInput(f"the arrays of a batch have {sorted(lengths)} rows, expected equal lengths")
        return [dict(zip(parts, row, strict=True)) for row in zip(*parts.values(), strict=True)]
    if isinstance(observations, (str, bytes)) or not isinstance(observations, (Sequence, np.ndarray)):
        kind = type(observations).__name__
        raise InvalidInput(
            f"a batch is {kind}, expected a list of observations, or arrays whose first axis is the batch"
        )
    return list(observations)


def to_json(body: Mapping[str, Any]) -> bytes:
    """Serialize the body of a request. Raises InvalidInput."""
    try:
        return orjson.dumps(body, option=orjson.OPT_SERIALIZE_NUMPY)
    except orjson.JSONEncodeError as error:
        raise InvalidInput(f"the observation cannot be encoded as JSON: {error}") from error


def _encode_array(array: NDArray, encoding: Encoding) -> Any:
    if array.dtype.kind not in "iufb":
        raise InvalidInput(f"an array of {array.dtype.name} cannot be encoded, expected numbers")
    if encoding == "lists" or not array.ndim:
        return array.tolist()
    if encoding == "png" and array.dtype == np.uint8 and array.ndim in (2, 3) and array.size:
        return {"png": _encode_image(array)}
    if array.dtype.str[0] == ">":
        array = array.astype(array.dtype.newbyteorder("<"))
    return {"b64": b64encode(array.tobytes()).decode(), "dtype": array.dtype.name, "shape": array.shape}


def _encode_image(image: NDArray) -> str | list[str]:
    """Return one PNG, or several PNGs that share the channels."""
    image = image.reshape(*image.shape[:2], -1)
    parts = [image[..., first : first + PNG_CHANNELS] for first in range(0, image.shape[2], PNG_CHANNELS)]
    return _encode_png(parts[0]) if len(parts) == 1 else [_encode_png(part) for part in parts]


def _encode_png(image: NDArray) -> str:
    from PIL import Image

    file = io.BytesIO()
    flat = image[..., 0] if image.shape[2] == 1 else image
    Image.fromarray(np.ascontiguousarray(flat)).save(file, "PNG", compress_level=PNG_COMPRESSION)
    return b64encode(file.getbuffer()).decode()


@dataclass(frozen=True, slots=True)
class ActionRequest:
    """The body of a request for one action.

    seed: seed for sampling, None if the request has none. With `explore`, a random one is chosen here if none is given,
    so that a repeated request has the same result.
    """

    body: JsonObject
    seed: int | None

    @classmethod
    def build(
        cls,
        observation: Any,
        encoding: Encoding,
        *,
        explore: bool | None = None,
        seed: int | None = None,
        probabilities: bool = False,
        state: str | None = None,
        deadline_ms: int | None = None,
        analysis: bool = False,
    ) -> "ActionRequest":
        """For the arguments see `Client.act`. Raises InvalidInput."""
        used_seed = _used_seed(explore, seed)
        body = {"observation": encode(observation, encoding)}
        return cls(body | _options(explore, used_seed, probabilities, state, deadline_ms, analysis), used_seed)


@dataclass(frozen=True, slots=True)
class BatchActionRequest:
    """The body of a request for the actions of a batch. seed: one for the batch, or one for each observation."""

    body: JsonObject
    seed: int | list[int] | None

    @classmethod
    def build(
        cls,
        observations: Any,
        encoding: Encoding,
        *,
        explore: bool | None = None,
        seed: int | Sequence[int] | None = None,
        probabilities: bool = False,
        state: Sequence[str | None] | None = None,
        deadline_ms: int | None = None,
        analysis: bool = False,
    ) -> "BatchActionRequest":
        """For the arguments see `Client.act_batch`. Raises InvalidInput."""
        requested_seed: int | list[int] | None = list(seed) if isinstance(seed, Sequence) else seed
        used_seed = _used_seed(explore, requested_seed)
        states = None if state is None else list(state)
        body = {"observations": [encode(row, encoding) for row in split_batch(observations)]}
        return cls(body | _options(explore, used_seed, probabilities, states, deadline_ms, analysis), used_seed)


Seed = TypeVar("Seed", bound=int | list[int])


def _used_seed(explore: bool | None, seed: Seed | None) -> Seed | int | None:
    """The seed of the request: none for greedy actions. The league may sample by default."""
    if explore is False:
        return None
    return random.getrandbits(63) if seed is None else seed


def _options(
    explore: bool | None, seed: Any, probabilities: bool, state: Any, deadline_ms: int | None, analysis: bool
) -> JsonObject:
    """Return the fields that differ from their defaults."""
    options = {
        "explore": explore,
        "seed": seed,
        "probabilities": probabilities or None,
        "state": state,
        "deadline_ms": deadline_ms,
        "analysis": analysis or None,
    }
    return {name: value for name, value in options.items() if value is not None}
