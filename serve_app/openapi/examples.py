"""Requests that a policy would answer, made from its manifest: examples for people, of no game in particular."""

from base64 import b64encode
from io import BytesIO
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from league.policies.actions import bounds
from league.spaces import ACTION_MASK, Box, DictSpace, Discrete, MultiDiscrete, Space
from serve_app.inference_protocol.datatypes import datatype_of
from serve_app.loading import LoadedPolicy

MOST_LISTED = 512
"""Numbers that a person is shown one by one; larger leaves are base64."""
MODES = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}
"""Values of a pixel → Pillow's name."""


def action_request(policy: LoadedPolicy) -> dict[str, Any]:
    """A body for the action route."""
    body = {"observation": observation(policy.manifest.observation)}
    return body | {"state": None} if policy.state else body


def infer_request(policy: LoadedPolicy) -> dict[str, Any] | None:
    """A body for the Open Inference Protocol in JSON; None where it would be too long for a person."""
    arrays = {name: _zeros(leaf, (1, *leaf.shape), name == ACTION_MASK) for name, _, leaf in policy.reader.leaves}
    if sum(array.size for array in arrays.values()) > MOST_LISTED:
        return None
    return {
        "inputs": [
            {"name": name, "datatype": datatype_of(array), "shape": list(array.shape), "data": array.ravel().tolist()}
            for name, array in arrays.items()
        ],
        "outputs": [{"name": "action"}],
    }


def observation(space: Space, is_mask: bool = False) -> Any:
    """A value of a space as JSON: nothing is there, and every action is legal."""
    if isinstance(space, DictSpace):
        return {key: observation(part, key == ACTION_MASK) for key, part in space.spaces.items()}
    return _leaf(_zeros(space, space.shape, is_mask))


def _zeros(leaf: Any, shape: tuple[int, ...], is_mask: bool = False) -> NDArray:
    """Zeros, or what is nearest to them in the space; ones for a mask."""
    if is_mask:
        return np.ones(shape, leaf.dtype)
    nothing: Any = 0
    match leaf:
        case Discrete(start=start) | MultiDiscrete(start=start):
            nothing = start
        case Box():
            nothing = np.clip(0.0, *bounds(leaf))
    return np.broadcast_to(np.asarray(nothing), shape).astype(leaf.dtype)


def _leaf(array: NDArray) -> Any:
    if array.size <= MOST_LISTED:
        return array.tolist()
    if array.dtype == np.uint8 and array.ndim in (2, 3) and (values := prod(array.shape[2:])) in MODES:
        return {"png": _picture(array, MODES[values])}
    data = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
    return {"b64": b64encode(data).decode(), "dtype": array.dtype.name, "shape": list(array.shape)}


def _picture(array: NDArray, mode: str) -> str:
    buffer = BytesIO()
    Image.frombytes(mode, (array.shape[1], array.shape[0]), array.tobytes()).save(buffer, "PNG")
    return b64encode(buffer.getvalue()).decode()
