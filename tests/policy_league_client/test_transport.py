"""Requests of the client to a server that fails: which errors are raised, and what is retried."""

import itertools
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar

import pytest

from league.errors import BodyTooLarge, InvalidInput, NotReady, ObservationError, RemoteError, UnknownLeague
from policy_league_client import Client, retries

DROP = (0, b"")
"""A prepared response that closes the connection."""


class Handler(BaseHTTPRequestHandler):
    """Returns the prepared responses in order, then the last one repeatedly."""

    protocol_version = "HTTP/1.1"
    responses: ClassVar[list[tuple[int, bytes]]] = []
    paths: ClassVar[list[str]] = []
    connections: ClassVar[set[tuple[str, int]]] = set()

    def do_POST(self) -> None:
        self.connections.add(self.client_address)
        self.rfile.read(int(self.headers["content-length"]))
        self.paths.append(self.path)
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


@pytest.fixture
def url(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(retries, "INITIAL_DELAY", 0.001)
    monkeypatch.setattr(retries, "monotonic", itertools.count().__next__)  # a second between two attempts
    for collection in (Handler.responses, Handler.paths, Handler.connections):
        collection.clear()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def prepare(*prepared: tuple[int, bytes]) -> None:
    Handler.responses[:] = prepared


def actions(*values: int) -> tuple[int, bytes]:
    return 200, json.dumps({"actions": values, "model": "board", "version": 1, "sha256": "0" * 64}).encode()


def error(status: int, code: str, message: str = "a sentence") -> tuple[int, bytes]:
    return status, json.dumps({"code": code, "message": message}).encode()


def test_connections_are_reused(url: str) -> None:
    prepare(actions(1, 1))
    with Client(url) as client:
        for _ in range(5):
            client.act_batch("board.left@7", [1, 2])
    assert len(Handler.connections) == 1
    assert set(Handler.paths) == {"/v1/policies/board.left/action?version=7"}


@pytest.mark.parametrize(
    "failure",
    [DROP, error(503, "not_ready"), (500, b"Internal Server Error"), (429, b"dropped due to backpressure")],
    ids=["dropped", "not ready", "HAProxy", "overloaded"],
)
def test_temporary_failures_are_retried(url: str, failure: tuple[int, bytes]) -> None:
    prepare(*[failure] * 5, actions(1, 1))
    with Client(url) as client:
        assert list(client.act_batch("board", [1, 2]).actions) == [1, 1]
    assert len(Handler.paths) == 6


@pytest.mark.parametrize(
    ("answer", "expected", "is_retried"),
    [
        (error(404, "unknown_league", "there is no league 'board'; known: none yet"), UnknownLeague, False),
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
    with Client(url, retry_deadline=2.5) as client, pytest.raises(expected) as raised:
        client.act_batch("board", [1, 2])
    assert type(raised.value) is expected
    assert len(Handler.paths) == (3 if is_retried else 1)
    if expected is UnknownLeague:
        assert str(raised.value).endswith("known: none yet"), "the message is the server's"


@pytest.mark.parametrize("address", ["127.0.0.1:8000", "ftp://host", "", "http://", "http://a:b"])
def test_an_invalid_address_is_rejected(address: str) -> None:
    with pytest.raises(InvalidInput, match="address of a server"):
        Client(address)
