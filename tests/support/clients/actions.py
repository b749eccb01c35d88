"""Requests for actions of the league `board`, and their observations."""

import copy
import json
from typing import Any

import numpy as np
from starlette.testclient import TestClient

BOARD = {"observation": np.zeros((6, 7, 2), int).tolist(), "action_mask": [1] * 7}


def boards(count: int, seed: int = 0) -> list[dict[str, Any]]:
    random = np.random.default_rng(seed)
    masks = random.integers(0, 2, (count, 7))
    masks[:, 3] = 1
    return [{"observation": random.integers(0, 2, (6, 7, 2)).tolist(), "action_mask": mask.tolist()} for mask in masks]


def act(client: TestClient, model: str = "board", version: Any = None, **body: Any) -> dict[str, Any]:
    reply = client.post(
        f"/v1/policies/{model}/action", json=body, params={} if version is None else {"version": version}
    )
    assert reply.status_code == 200, reply.text
    return reply.json()


def rejected(client: TestClient, body: Any, status: int = 400, model: str = "board", **more: Any) -> dict[str, str]:
    """Send a request that is rejected; returns its error, which has a code and a message."""
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    reply = client.post(f"/v1/policies/{model}/action", **({"content": content} | more))
    assert reply.status_code == status, reply.text
    error = reply.json()
    assert error.keys() == {"code", "message"}
    return error


def invalid_request(**changes: Any) -> dict[str, Any]:
    """A request with an invalid observation."""
    board = copy.deepcopy(BOARD) | changes
    return {"observation": {key: value for key, value in board.items() if value is not None}}


BAD_BODIES: dict[str, tuple[Any, str, str]] = {
    "empty": (b"", "malformed_body", "empty"),
    "no JSON": (b"{'observation': 1}", "malformed_body", "not JSON"),
    "cut": (b'{"observation": [1, 2', "malformed_body", "not JSON"),
    "NaN": (b'{"observation": [NaN]}', "malformed_body", "not JSON"),
    "Infinity": (b'{"observation": [Infinity]}', "malformed_body", "not JSON"),
    "bytes": (bytes(range(256)), "malformed_body", "not JSON"),
    "deep": (b'{"observation": ' + b"[" * 10_000 + b"]" * 10_000 + b"}", "malformed_body", "not JSON"),
    "deep for NumPy": (b'{"observation": ' + b"[" * 500 + b"]" * 500 + b"}", "invalid_observation", "a list"),
    "a list": ([1, 2], "malformed_body", "a list, expected an object"),
    "a string": ("board", "malformed_body", "a string, expected an object"),
    "null": (None, "malformed_body", "null, expected an object"),
    "nothing": ({}, "invalid_input", "neither observation nor observations"),
    "both": ({"observation": BOARD, "observations": [BOARD]}, "invalid_input", "both"),
    "unknown key": ({"observation": BOARD, "exlpore": True}, "invalid_input", "exlpore"),
    "explore a number": ({"observation": BOARD, "explore": 1}, "invalid_input", "explore is a number"),
    "explore a string": ({"observation": BOARD, "explore": "yes"}, "invalid_input", "explore is a string"),
    "seed a fraction": ({"observation": BOARD, "seed": 0.5}, "invalid_input", "seed must be"),
    "seed negative": ({"observation": BOARD, "seed": -1}, "invalid_input", "seed must be"),
    "seed huge": ({"observation": BOARD, "seed": 2**64}, "invalid_input", "seed must be"),
    "seed a boolean": ({"observation": BOARD, "seed": True}, "invalid_input", "seed must be"),
    "seeds for one": ({"observation": BOARD, "seed": [1]}, "invalid_input", "seed must be"),
    "too few seeds": ({"observations": [BOARD] * 2, "seed": [1]}, "invalid_input", "expected 2"),
    "no batch": ({"observations": BOARD}, "invalid_input", "observations is an object"),
    "empty batch": ({"observations": []}, "invalid_input", "empty"),
    "a wrong one in a batch": ({"observations": [BOARD, 3]}, "invalid_observation", "a number"),
    "no mask": (invalid_request(action_mask=None), "invalid_observation", "observation lacks the key action_mask"),
    "bare list": ({"observation": BOARD["observation"]}, "invalid_observation", "observation, action_mask"),
    "null observation": ({"observation": None}, "invalid_observation", "observation is null"),
    "unknown key inside": (invalid_request(reward=1), "invalid_observation", "'reward'"),
    "wrong shape": (invalid_request(observation=[[0, 1]]), "invalid_observation", "expected [6, 7, 2]"),
    "a number for a board": (invalid_request(observation=3), "invalid_observation", "expected [6, 7, 2]"),
    "ragged": (invalid_request(observation=[[0], [0, 1]]), "invalid_observation", "ragged"),
    "an object inside": (invalid_request(observation=[{"a": 1}]), "invalid_observation", "values that are not numbers"),
    "null inside": (
        invalid_request(observation=[[[None, 0]] * 7] * 6),
        "invalid_observation",
        "values that are not numbers",
    ),
    "numbers as strings": (
        invalid_request(observation=[[["0", "1"]] * 7] * 6),
        "invalid_observation",
        "where a number",
    ),
    "fractions for integers": (invalid_request(observation=[[[0.5, 0]] * 7] * 6), "invalid_observation", "int8"),
    "too large for the dtype": (invalid_request(observation=[[[300, 0]] * 7] * 6), "invalid_observation", "127"),
    "too large for any dtype": (invalid_request(observation=[[[10**30, 0]] * 7] * 6), "invalid_observation", "127"),
    "nothing legal": (invalid_request(action_mask=[0] * 7), "illegal_mask", "at least one"),
    "mask of twos": (invalid_request(action_mask=[2] + [1] * 6), "illegal_mask", "0 and 1"),
    "negative mask": (invalid_request(action_mask=[-1] + [1] * 6), "illegal_mask", "0 and 1"),
    "short mask": (invalid_request(action_mask=[1] * 6), "invalid_observation", "expected [7]"),
    "flat batch of masks": (invalid_request(action_mask=[[1] * 7]), "invalid_observation", "expected [7]"),
}
