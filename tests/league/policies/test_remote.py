"""The remote policy: its requests, how it parses responses, and what it retries."""

import base64
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar

import numpy as np
import pytest

from league.client import retries
from league.errors import (
    BodyTooLarge,
    InvalidInput,
    InvalidReference,
    NotReady,
    ObservationError,
    RemoteError,
    UnknownLeague,
)
from league.policies.remote import RemotePolicy

BOARD = {"observation": np.zeros((2, 6, 7, 2), np.int8), "action_mask": np.ones((2, 7), np.int8)}
DROP = (0, b"")
"""A prepared response that closes the connection."""


class Handler(BaseHTTPRequestHandler):
    """Returns the prepared responses in order, then the last one repeatedly; records requests, with arrays as lists."""

    protocol_version = "HTTP/1.1"
    responses: ClassVar[list[tuple[int, bytes]]] = []
    requests: ClassVar[list[tuple[str, Any]]] = []
    connections: ClassVar[set[tuple[str, int]]] = set()

    def do_POST(self) -> None:
        self.connections.add(self.client_address)
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        self.requests.append((self.path, as_lists(body)))
        status, body = self.responses.pop(0) if len(self.responses) > 1 else self.responses[0]
        if not status:
            self.close_connection = True
            return
        self.send_response(status)
        self.send_header("content-length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Log nothing."""


def as_lists(value: Any) -> Any:
    """A document with arrays as nested lists instead of base64."""
    if isinstance(value, dict) and "b64" in value:
        return np.frombuffer(base64.b64decode(value["b64"]), value["dtype"]).reshape(value["shape"]).tolist()
    if isinstance(value, dict):
        return {key: as_lists(part) for key, part in value.items()}
    return [as_lists(part) for part in value] if isinstance(value, list) else value


@pytest.fixture
def url(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(retries, "INITIAL_DELAY", 0.001)
    monkeypatch.setattr(retries, "NOT_READY_DEADLINE", 30.0)
    for collection in (Handler.responses, Handler.requests, Handler.connections):
        collection.clear()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def prepare(*prepared: tuple[int, bytes]) -> None:
    Handler.responses[:] = prepared


def actions(*given: Any) -> tuple[int, bytes]:
    return 200, json.dumps({"actions": given, "model": "board", "version": 1, "sha256": "0" * 64}).encode()


def error(status: int, code: str, message: str = "a sentence") -> tuple[int, bytes]:
    return status, json.dumps({"code": code, "message": message}).encode()


def test_a_batch_is_sent_as_rows(url: str) -> None:
    prepare(actions(3, 4))
    with RemotePolicy(url, "board.left", version=7) as policy:
        answer = policy.act(BOARD)
    assert (answer.actions.tolist(), answer.actions.dtype, answer.state) == ([3, 4], np.int64, None)
    board = {"observation": np.zeros((6, 7, 2), int).tolist(), "action_mask": [1] * 7}
    assert Handler.requests == [
        ("/v1/policies/board.left/action?version=7", {"observations": [board, board], "explore": False, "state": {}})
    ]


def test_nested_observations_are_rebuilt_from_their_names(url: str) -> None:
    prepare(actions(0))
    policy = RemotePolicy(url, "board")
    policy.act({"observation.a.b": np.ones((1, 2), np.float32), "observation.c": np.array([3])})
    policy.act({"observation.grid": np.array([[1]]), "action_mask": np.array([[1, 0]])})
    policy.act({"observation": np.array([5])})
    sent = [body["observations"] for _, body in Handler.requests]
    assert sent == [[{"a": {"b": [1.0, 1.0]}, "c": 3}], [{"observation": {"grid": [1]}, "action_mask": [1, 0]}], [5]]


def test_vectors_and_state_are_returned_as_float32(url: str) -> None:
    reply = {"actions": [[0.5, -1.0]], "state": {"state_in_0": [[1.5]]}}
    prepare((200, json.dumps(reply).encode()))
    answer = RemotePolicy(url, "vector").act(
        {"observation": np.zeros((1, 2), np.float32)}, state={"state_in_0": np.ones((1, 1), np.float32)}
    )
    assert answer.actions.dtype == np.float32
    assert answer.state is not None
    np.testing.assert_array_equal(answer.state["state_in_0"], np.array([[1.5]], np.float32))
    assert Handler.requests[0][1]["state"] == {"state_in_0": [[1.0]]}


def test_each_row_explores_with_its_own_generator(url: str) -> None:
    prepare(actions(0, 0))
    generators = [np.random.default_rng(seed) for seed in (1, 2)]
    RemotePolicy(url, "board").act(BOARD, explore=True, rng=generators)
    expected = [int(np.random.default_rng(seed).integers(2**63)) for seed in (1, 2)]
    assert Handler.requests[0][1]["seed"] == expected
    with pytest.raises(InvalidInput, match="rng"):
        RemotePolicy(url, "board").act(BOARD, explore=True)


def test_connections_are_reused(url: str) -> None:
    prepare(actions(1, 1))
    with RemotePolicy(url, "board") as policy:
        for _ in range(5):
            policy.act(BOARD)
    assert len(Handler.connections) == 1


@pytest.mark.parametrize(
    "failure",
    [DROP, error(503, "not_ready"), (500, b"Internal Server Error"), (429, b"dropped due to backpressure")],
    ids=["dropped", "not ready", "HAProxy", "overloaded"],
)
def test_temporary_failures_are_retried(url: str, failure: tuple[int, bytes]) -> None:
    prepare(*[failure] * 5, actions(1, 1))
    assert RemotePolicy(url, "board").act(BOARD).actions.tolist() == [1, 1]
    assert len(Handler.requests) == 6


@pytest.mark.parametrize(
    ("answer", "expected", "is_retried"),
    [
        (error(404, "unknown_league", "there is no league 'board'"), UnknownLeague, False),
        (error(400, "invalid_observation"), ObservationError, False),
        (error(413, "body_too_large"), BodyTooLarge, False),
        (error(503, "not_ready"), NotReady, True),
        (error(500, "internal_error"), RemoteError, False),
        ((200, b"<html>"), RemoteError, False),
        ((404, b"HAProxy knows of no replica yet"), RemoteError, True),
        ((500, b"Internal Server Error"), RemoteError, True),
        (DROP, RemoteError, True),
    ],
)
def test_errors_are_raised(url: str, answer: tuple[int, bytes], expected: type[Exception], is_retried: bool) -> None:
    prepare(answer)
    with pytest.raises(expected) as raised:
        RemotePolicy(url, "board", retry_deadline=0.5).act(BOARD)
    assert type(raised.value) is expected
    assert (len(Handler.requests) > 1) == is_retried


def test_the_message_of_the_server_is_kept(url: str) -> None:
    prepare(error(404, "unknown_league", "there is no league 'board'; known: none yet"))
    with pytest.raises(UnknownLeague, match="known: none yet"):
        RemotePolicy(url, "board").act(BOARD)


def test_an_unreachable_server_is_reported() -> None:
    with pytest.raises(RemoteError, match=r"127\.0\.0\.1:9/v1/policies/board/action cannot be reached"):
        RemotePolicy("http://127.0.0.1:9", "board", retry_deadline=0.05).act(BOARD)


@pytest.mark.parametrize("address", ["127.0.0.1:8000", "ftp://host", "", "http://", "http://a:b"])
def test_an_invalid_address_is_rejected(address: str) -> None:
    with pytest.raises(InvalidInput, match="address of a server"):
        RemotePolicy(address, "board")


@pytest.mark.parametrize(("model", "version"), [("Board", None), ("a.b.c", None), ("board", "no such")])
def test_an_invalid_reference_is_rejected(model: str, version: str | None) -> None:
    with pytest.raises(InvalidReference):
        RemotePolicy("http://127.0.0.1:9", model, version)
