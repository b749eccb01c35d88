"""Requests to a server that fails: which are retried, how a retry repeats them, and which errors are raised."""

import itertools
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import httpx
import pytest

from league import errors
from policy_league_client import retries
from policy_league_client.retries import Retries
from tests.support.clients.sync_and_async import Connect

DROP, NO_RESPONSE = 0, 1
"""In place of a status: close the connection without a response, or do not respond."""
MOVED = {"league": "board", "alias": "champion", "kind": "promotion", "version": 2, "previous": 1, "event": 3}
MOVED |= {"actor": "player", "reason": "", "at": "2026-11-21T00:00:00+00:00"}
ACTED = {"action": 4, "model": "board", "version": 1, "sha256": "0"}


class Server:
    """Returns the prepared responses in order, then the last one repeatedly."""

    def __init__(self) -> None:
        self.answers: list[tuple[int, Any, dict[str, str]]] = []
        self.requests: list[tuple[bytes, dict[str, str]]] = []
        self.paths: list[str] = []
        self.connections = set[tuple[str, int]]()
        self.is_over = threading.Event()

    def prepare(self, *statuses: int, then: dict[str, Any], **headers: str) -> None:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        codes = {429: "overloaded", 503: "not_ready", 504: "deadline_exceeded"}
        failures = [(status, {"code": codes.get(status, ""), "message": "no"}, named) for status in statuses]
        self.answers = [*failures, (200, then, {})]

    def handler(self) -> type[BaseHTTPRequestHandler]:
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            wbufsize = -1  # head and body in one packet: the second of two waits 40 ms

            def do_POST(self) -> None:
                server.connections.add(self.client_address)
                server.paths.append(self.path)
                body = self.rfile.read(int(self.headers["content-length"]))
                server.requests.append((body, {name.lower(): value for name, value in self.headers.items()}))
                status, document, headers = server.answers.pop(0) if len(server.answers) > 1 else server.answers[0]
                if status == NO_RESPONSE:
                    server.is_over.wait()
                if status in (DROP, NO_RESPONSE):
                    self.close_connection = True
                    return
                answer = document if isinstance(document, bytes) else json.dumps(document).encode()
                self.send_response(status)
                for name, value in {"content-length": str(len(answer)), **headers}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(answer)

            def log_message(self, *_: Any) -> None:
                """Log nothing."""

        return Handler


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    listener = ThreadingHTTPServer(("127.0.0.1", 0), server.handler())
    server.url = f"http://127.0.0.1:{listener.server_port}"  # type: ignore[attr-defined]
    thread = threading.Thread(target=listener.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    yield server
    server.is_over.set()
    listener.shutdown()
    listener.server_close()


@pytest.fixture(autouse=True)
def short_delays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retries, "INITIAL_DELAY", 0.001)


def test_a_promotion_is_retried_with_the_same_idempotency_key(connect: Connect, server: Server) -> None:
    server.prepare(DROP, 503, NO_RESPONSE, then=MOVED)
    client = connect(server.url, key="plk_x", timeout=0.1)
    assert client.promote("board@2", expected=1, reason="better").event == 3
    bodies, headers = zip(*server.requests, strict=True)
    assert len(bodies) >= 4, "a busy machine may be late for the last attempt, too"
    assert set(bodies) == {b'{"version":2,"expected":1,"reason":"better"}'}
    assert len({sent["idempotency-key"] for sent in headers}) == 1
    assert {sent["authorization"] for sent in headers} == {"Bearer plk_x"}
    assert {sent["x-request-timeout-ms"] for sent in headers} == {"100"}
    client.promote("board@2", idempotency_key="mine")
    assert server.requests[-1][1]["idempotency-key"] == "mine"
    client.rollback("board")
    assert len({sent["idempotency-key"] for _, sent in server.requests}) == 3, "each call has its own key"


def test_a_retry_repeats_the_seed(connect: Connect, server: Server) -> None:
    server.prepare(DROP, 429, 504, then=ACTED, retry_after="0")
    answer = connect(server.url).act("board", [1], explore=True)
    bodies = {body for body, _ in server.requests}
    assert len(server.requests) == 4
    assert [json.loads(body)["seed"] for body in bodies] == [answer.seed]


def test_the_timeout_applies_to_each_attempt(connect: Connect, server: Server) -> None:
    server.prepare(NO_RESPONSE, NO_RESPONSE, then=ACTED)
    assert connect(server.url, timeout=0.1).act("board", [1]).action == 4  # on a busy machine, others time out, too
    assert len({body for body, _ in server.requests}) == 1


def reply(status: int, code: str | None = "x", **headers: str) -> httpx.Response:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    document = {"code": code, "message": "no"}
    return httpx.Response(status, headers=named, json=document if code else None)


def test_which_outcomes_are_retried(monkeypatch: pytest.MonkeyPatch, subtests: pytest.Subtests) -> None:
    lost = (httpx.ConnectError("refused"), httpx.ReadTimeout("late"), httpx.RemoteProtocolError("hung up"))
    not_ours = [reply(status, None) for status in (404, 500)]
    repeated = (*lost, *(reply(status) for status in (429, 502, 503, 504)), *not_ours)
    final = (*(reply(status) for status in (200, 400, 401, 404, 409, 410, 413, 500)), reply(403, None))
    for outcome in (*repeated, *final):
        with subtests.test(outcome=outcome):
            assert (Retries(10).next_delay(outcome) is not None) == (outcome in repeated)
            assert Retries(0).next_delay(outcome) is None
    assert (Retries(10).next_delay(reply(429, retry_after="3")) or 0) >= 3
    assert Retries(2).next_delay(reply(429, retry_after="3")) is None
    for invalid in ("soon", "-1", "1.5", ""):
        assert (Retries(10).next_delay(reply(429, retry_after=invalid)) or 9) < 1
    monkeypatch.setattr(retries, "NOT_READY_DEADLINE", 1.0)
    monkeypatch.setattr(retries, "INITIAL_DELAY", 2.0)
    monkeypatch.setattr(retries, "JITTER", 0.0)
    assert Retries(10).next_delay(reply(503, "not_ready")) is None
    assert Retries(10).next_delay(reply(503, "no_replica")) is not None, "it waits longer for a replica"


def test_delays_grow_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retries, "INITIAL_DELAY", 0.01)
    attempts = Retries(1e9)
    delays = [attempts.next_delay(httpx.ConnectError("refused")) or 0.0 for _ in range(12)]
    for number, delay in enumerate(delays):
        expected = min(0.01 * 2**number, 1.0)
        assert expected / 2 <= delay <= 1.5 * expected
    assert len(set(delays)) == 12, "delays have jitter"


def error(status: int, code: str, message: str = "a sentence") -> tuple[int, Any]:
    return status, {"code": code, "message": message}


def test_connections_are_reused(connect: Connect, server: Server) -> None:
    server.prepare(then=ACTED)
    client = connect(server.url)
    for _ in range(5):
        client.act("board.left@7", [1])
    assert len(server.connections) == 1
    assert set(server.paths) == {"/v1/policies/board.left/action?version=7"}


FAILURES: tuple[tuple[tuple[int, Any], type[Exception], bool], ...] = (
    (error(404, "unknown_league", "there is no league 'board'; known: none yet"), errors.UnknownLeague, False),
    (error(400, "invalid_observation"), errors.ObservationError, False),
    (error(413, "body_too_large"), errors.BodyTooLarge, False),
    (error(503, "not_ready"), errors.NotReady, True),
    (error(500, "internal_error"), errors.RemoteError, False),
    ((200, b"<html>"), errors.RemoteError, False),
    ((404, b"HAProxy knows of no replica yet"), errors.RemoteError, True),
    ((429, b"dropped due to backpressure"), errors.RemoteError, True),
    ((500, b"Internal Server Error"), errors.RemoteError, True),
    ((DROP, b""), errors.RemoteError, True),
)


def test_errors_are_raised_unless_they_are_temporary(
    connect: Connect, server: Server, monkeypatch: pytest.MonkeyPatch, subtests: pytest.Subtests
) -> None:
    monkeypatch.setattr(retries, "monotonic", itertools.count().__next__)  # a second between two attempts
    for failure, expected, is_temporary in FAILURES:
        with subtests.test(failure=failure):
            server.requests, server.answers = [], [(*failure, {})]
            with pytest.raises(expected) as raised:
                connect(server.url, retry_deadline=2.5).act("board", [1])
            assert type(raised.value) is expected
            assert len(server.requests) == (3 if is_temporary else 1)
            if expected is errors.UnknownLeague:
                assert str(raised.value).endswith("known: none yet"), "the message is the server's"
            if is_temporary:
                server.requests, server.answers = [], [(*failure, {})] * 5 + [(200, ACTED, {})]
                assert connect(server.url).act("board", [1]).action == 4
                assert len(server.requests) == 6
