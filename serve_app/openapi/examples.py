"""Examples of requests for a served policy."""

from base64 import b64encode
from io import BytesIO
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from league.spaces import ACTION_MASK, Box, Discrete, MultiDiscrete, Space, inputs
from league.spaces.arrays import bounds, nested
from serve_app.inference_protocol.tensors import datatype_of
from serve_app.live_versions.version_cache import LoadedPolicy

MAX_LISTED = 512
"""Maximum numbers listed in an example; larger leaves are base64."""
MODES = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}
"""Channels → Pillow mode."""


def action_request(policy: LoadedPolicy) -> dict[str, Any]:
    """An example body for the action route."""
    body = {"observation": observation(policy.manifest.observation)}
    return body | {"state": None} if policy.state else body


def infer_request(policy: LoadedPolicy) -> dict[str, Any] | None:
    """An example body for the Open Inference Protocol in JSON; None if it would be too long."""
    arrays = {name: _zeros(leaf, (1, *leaf.shape), name == ACTION_MASK) for name, _, leaf in policy.reader.leaves}
    if sum(array.size for array in arrays.values()) > MAX_LISTED:
        return None
    return {
        "inputs": [
            {"name": name, "datatype": datatype_of(array), "shape": list(array.shape), "data": array.ravel().tolist()}
            for name, array in arrays.items()
        ],
        "outputs": [{"name": "action"}],
    }


def observation(space: Space) -> Any:
    """An example value of a space as JSON, with every action legal."""
    leaves = inputs(space).items()
    return nested(space, {name: _leaf(_zeros(leaf, leaf.shape, name == ACTION_MASK)) for name, leaf in leaves})


def _zeros(leaf: Any, shape: tuple[int, ...], is_mask: bool = False) -> NDArray:
    """Zeros or the nearest values in the space; ones for a mask."""
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
    if array.size <= MAX_LISTED:
        return array.tolist()
    if array.dtype == np.uint8 and array.ndim in (2, 3) and (values := prod(array.shape[2:])) in MODES:
        return {"png": _picture(array, MODES[values])}
    data = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
    return {"b64": b64encode(data).decode(), "dtype": array.dtype.name, "shape": list(array.shape)}


def _picture(array: NDArray, mode: str) -> str:
    buffer = BytesIO()
    Image.frombytes(mode, (array.shape[1], array.shape[0]), array.tobytes()).save(buffer, "PNG")
    return b64encode(buffer.getvalue()).decode()
