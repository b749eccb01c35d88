"""Requests for actions, mostly of the league `board`, and their observations."""

import json
from base64 import b64encode
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.testclient import TestClient

from league.registry.storage.manifest import episode_position
from serve_app.live_versions.traffic_split import CANARY

BOARD = {"observation": np.zeros((6, 7, 2), int).tolist(), "action_mask": [1] * 7}
DATATYPES = {"int8": "INT8", "int64": "INT64", "float32": "FP32"}


def boards(count: int, seed: int = 0) -> list[dict[str, Any]]:
    random = np.random.default_rng(seed)
    masks = random.integers(0, 2, (count, 7))
    masks[:, 3] = 1
    return [{"observation": random.integers(0, 2, (6, 7, 2)).tolist(), "action_mask": mask.tolist()} for mask in masks]


def board_arrays(batch: list[dict[str, Any]]) -> dict[str, NDArray]:
    """The inputs of the graph for some boards."""
    return {name: np.array([board[name] for board in batch], np.int8) for name in BOARD}


def inference(arrays: Mapping[str, NDArray]) -> dict[str, Any]:
    """A request of the Open Inference Protocol in JSON."""
    tensors = [
        {"name": name, "datatype": DATATYPES[array.dtype.name], "shape": array.shape, "data": array.ravel().tolist()}
        for name, array in arrays.items()
    ]
    return {"inputs": tensors}


def act(client: TestClient, model: str = "board", version: Any = None, **body: Any) -> dict[str, Any]:
    reply = client.post(
        f"/v1/policies/{model}/action", json=body, params={} if version is None else {"version": version}
    )
    assert reply.status_code == 200, reply.text
    return reply.json()


def version_for(client: TestClient, key: str | None = None, **params: str) -> int:
    """The version of `board` that answers a caller with a key."""
    headers = {} if key is None else {"x-league-key": key}
    reply = client.post("/v1/policies/board/action", json={"observation": BOARD}, headers=headers, params=params)
    assert reply.status_code == 200, reply.text
    return int(reply.json()["version"])


def key_position(league: str, key: bytes) -> float:
    """A key below the share of a canary is answered by it."""
    return episode_position(league, key, CANARY)


def rejected(client: TestClient, body: Any, status: int = 400, model: str = "board", **more: Any) -> dict[str, str]:
    """Send a request that is rejected; returns its error, which has a code and a message."""
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    reply = client.post(f"/v1/policies/{model}/action", **({"content": content} | more))
    assert reply.status_code == status, reply.text
    error = reply.json()
    assert error.keys() == {"code", "message"}
    return error


def change(client: TestClient, path: str, key: str, body: Any = None, status: int = 200) -> dict[str, Any]:
    """The response to a change with an idempotency key."""
    content = body if isinstance(body, bytes) else json.dumps(body or {}).encode()
    reply = client.post(path, content=content, headers={"idempotency-key": key})
    assert reply.status_code == status, reply.text
    return reply.json()


def b64(array: Any, **more: Any) -> dict[str, Any]:
    array = np.asarray(array)
    return {"b64": b64encode(array.astype(array.dtype.newbyteorder("<")).tobytes()).decode()} | more


def _board(**changes: Any) -> dict[str, Any]:
    """A request with an invalid board."""
    return {"observation": BOARD | changes}


MALFORMED: dict[str, tuple[Any, str]] = {
    "empty": (b"", "empty"),
    "no JSON": (b"{'observation': 1}", "not JSON"),
    "cut": (b'{"observation": [1, 2', "not JSON"),
    "NaN": (b'{"observation": [NaN]}', "not JSON"),
    "Infinity": (b'{"observation": [Infinity]}', "not JSON"),
    "bytes": (bytes(range(256)), "not JSON"),
    "deep": (b'{"observation": ' + b"[" * 10_000 + b"]" * 10_000 + b"}", "not JSON"),
    "a list": ([1, 2], "a list, expected an object"),
    "a string": ("board", "a string, expected an object"),
    "null": (None, "null, expected an object"),
}
"""Bodies that are no objects, and their error messages."""

INVALID: dict[str, tuple[str, Any, str, str]] = {
    **{name: ("board", body, "malformed_body", message) for name, (body, message) in MALFORMED.items()},
    "nothing": ("board", {}, "invalid_input", "neither observation nor observations"),
    "unknown key": ("board", _board() | {"exlpore": True}, "invalid_input", "exlpore"),
    "explore a number": ("board", _board() | {"explore": 1}, "invalid_input", "explore is a number"),
    "seed a fraction": ("board", _board() | {"seed": 0.5}, "invalid_input", "seed must be"),
    **{
        name: (model, body, "invalid_observation", message)
        for name, model, body, message in (
            ("deep for NumPy", "board", b'{"observation": ' + b"[" * 500 + b"]" * 500 + b"}", "a list"),
            ("one of a batch", "board", {"observations": [BOARD, 3]}, "a number"),
            ("no mask", "board", {"observation": {"observation": []}}, "observation lacks the key action_mask"),
            ("bare list", "board", {"observation": BOARD["observation"]}, "observation, action_mask"),
            ("null observation", "board", {"observation": None}, "observation is null"),
            ("unknown key inside", "board", _board(reward=1), "'reward'"),
            ("wrong shape", "board", _board(observation=[[0, 1]]), "expected [6, 7, 2]"),
            ("a number for a board", "board", _board(observation=3), "expected [6, 7, 2]"),
            ("ragged", "board", _board(observation=[[0], [0, 1]]), "ragged"),
            ("an object inside", "board", _board(observation=[{"a": 1}]), "values that are not numbers"),
            ("null inside", "board", _board(observation=[[[None, 0]] * 7] * 6), "values that are not numbers"),
            ("numbers as strings", "board", _board(observation=[[["0", "1"]] * 7] * 6), "where a number"),
            ("strings beside base64", "board", _board(observation=[["0"]], action_mask=b64([1] * 7)), "where a number"),
            ("fractions for integers", "board", _board(observation=[[[0.5, 0]] * 7] * 6), "int8"),
            ("too large for the dtype", "board", _board(observation=[[[300, 0]] * 7] * 6), "127"),
            ("too large for any dtype", "board", _board(observation=[[[10**30, 0]] * 7] * 6), "127"),
            ("short mask", "board", _board(action_mask=[1] * 6), "expected [7]"),
            ("flat batch of masks", "board", _board(action_mask=[[1] * 7]), "expected [7]"),
            ("floats in base64", "board", _board(action_mask=b64(np.ones(7, np.float32))), "28 bytes, expected 7"),
            ("another vector", "vector", {"observation": [1, 2, 3]}, "expected [2]"),
            ("too large for infinity", "vector", b'{"observation": [1e39, 0]}', "finite"),
            ("infinity in base64", "vector", {"observation": b64(np.array([np.inf, 0], np.float32))}, "infinity"),
            ("an object for a vector", "vector", {"observation": BOARD}, "values that are not numbers"),
            # NumPy would make each of these strings as wide as the longest one: 16 MB.
            ("strings of unequal length", "vector", {"observation": ["x" * 4_000] + [""] * 1_000}, "where a number"),
            ("no image", "vector", {"observation": {"png": "AAAA"}}, "which png cannot encode"),
            ("out of range", "nested", {"observation": {"mode": 4, "sense": {"speed": [1, 1]}}}, "between 1 and 3"),
            (
                "out of range in base64",
                "nested",
                {"observation": {"mode": b64(np.int64(9)), "sense": {"speed": [1, 1]}}},
                "between 1 and 3",
            ),
            ("a list inside", "nested", {"observation": {"mode": 1, "sense": [1, 1]}}, "observation.sense is a list"),
        )
    },
    **{
        name: ("board", _board(action_mask=mask), "illegal_mask", message)
        for name, mask, message in (
            ("nothing legal", [0] * 7, "at least one"),
            ("nothing legal in base64", b64(np.zeros(7, np.int8)), "at least one"),
            ("mask of twos", [2] + [1] * 6, "0 and 1"),
            ("negative mask", [-1] + [1] * 6, "0 and 1"),
        )
    },
}
"""Model, body of a request that is refused, code and part of the message of the error."""
