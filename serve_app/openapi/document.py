"""Builds the OpenAPI document: the declared routes, with the limits of this server and examples for its policies."""

from base64 import b64encode
from collections.abc import Iterable
from copy import deepcopy
from functools import cache
from importlib.metadata import version as installed
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from league.spaces import ACTION_MASK, Box, Discrete, MultiDiscrete, Space, inputs
from league.spaces.arrays import bounds, nested
from serve_app.live_versions.policies import LoadedPolicy, LoadedVersion
from serve_app.openapi.operations import KEY, Document, describe
from serve_app.routes.table import ROUTES
from serve_app.settings import ServeSettings

SOURCE = Path(__file__).with_name("openapi.yaml")
ACTION_PATH = "/v1/policies/{model}/action"
INFER_PATHS = ("/v2/models/{model}/infer", "/v2/models/{model}/versions/{version}/infer")


def document(settings: ServeSettings, served: Iterable[LoadedVersion]) -> Document:
    """The OpenAPI document. `served`: versions whose policies get examples."""
    described = deepcopy(_source())
    described["servers"] = [{"url": settings.root_path or "/"}]
    described["info"]["version"] = installed("policy-league")
    schemas = described["components"]["schemas"]
    schemas["ActionRequest"]["properties"]["observations"]["maxItems"] = settings.max_batch
    described["info"]["description"] += (
        f"\n**Limits.** {settings.max_body:,} bytes and {settings.max_batch:,} observations per request, "
        f"{settings.max_in_flight:,} concurrent requests, a timeout of {settings.timeout:g} s.\n"
    )
    policies = {policy.model: policy for version in served for policy in version.policies.values()}
    if policies:
        _show(described, policies)
    return described


def _show(described: Document, policies: dict[str, LoadedPolicy]) -> None:
    """Insert examples of the policies before the general ones. `x-model`: the model of an example."""
    acting = {_key(model): _example(model, action_request(policy)) for model, policy in policies.items()}
    body = _body(described, ACTION_PATH)
    body["examples"] = acting | body["examples"]
    inferring = {
        _key(model): _example(model, request)
        for model, policy in policies.items()
        if (request := infer_request(policy)) is not None
    }
    for path in INFER_PATHS:
        body = _body(described, path)
        body["examples"] = inferring | body["examples"]
    parameters = described["components"]["parameters"]
    parameters["model"]["example"] = next(iter(policies))
    parameters["league"]["example"] = next(iter(policies)).partition(".")[0]


def _body(described: Document, path: str) -> Document:
    body: Document = described["paths"][path]["post"]["requestBody"]["content"]["application/json"]
    return body


def _example(model: str, value: Any) -> Document:
    return {"summary": model, "value": value, "x-model": model}


def _key(model: str) -> str:
    return f"of_{model}"


@cache
def _source() -> Document:
    """The document without what depends on the server."""
    # Several times as fast as SafeLoader, if PyYAML was built with libyaml.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    source: Document = yaml.load(SOURCE.read_text("utf-8"), loader)
    examples = source.pop("examples")
    paths, components = describe(ROUTES, examples["requests"], examples["responses"])
    components["schemas"] |= source["components"]["schemas"]
    return source | {"security": [{}, *KEY], "paths": paths, "components": source["components"] | components}


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
    if sum(prod(port.leaf.shape) for port in policy.observed) > MAX_LISTED:
        return None
    arrays = [_zeros(port.leaf, (1, *port.leaf.shape), port.name == ACTION_MASK) for port in policy.observed]
    return {
        "inputs": [
            {"name": port.name, "datatype": port.datatype, "shape": list(array.shape), "data": array.ravel().tolist()}
            for port, array in zip(policy.observed, arrays, strict=True)
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
