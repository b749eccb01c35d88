"""Which requests are retried, and that a retry repeats the request exactly."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import httpx
import pytest

from league.errors import DeadlineExceeded, NotReady, Overloaded, RateLimited, RemoteError
from policy_league_client import retries
from policy_league_client.retries import Retries
from tests.support.clients.sync_and_async import Connect

DROP, NO_RESPONSE = 0, 1
"""In place of a status: close the connection without a response, or do not respond."""
MOVED = {
    "league": "board",
    "alias": "champion",
    "kind": "promotion",
    "version": 2,
    "previous": 1,
    "actor": "player",
    "reason": "",
    "at": "2026-11-21T00:00:00+00:00",
    "event": 3,
}
ACTED = {"action": 4, "model": "board", "version": 1, "sha256": "0"}


class Server:
    """Returns the prepared responses in order, then the last one repeatedly."""

    def __init__(self) -> None:
        self.answers: list[tuple[int, dict[str, Any], dict[str, str]]] = []
        self.requests: list[tuple[bytes, dict[str, str]]] = []
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

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                server.requests.append((body, {name.lower(): value for name, value in self.headers.items()}))
                status, document, headers = server.answers.pop(0) if len(server.answers) > 1 else server.answers[0]
                if status == NO_RESPONSE:
                    server.is_over.wait()
                if status in (DROP, NO_RESPONSE):
                    self.close_connection = True
                    return
                answer = json.dumps(document).encode()
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
    client = connect(server.url, key="plk_x", timeout=0.3)
    assert client.promote("board@2", expected=1, reason="better").event == 3
    bodies, headers = zip(*server.requests, strict=True)
    assert len(bodies) >= 4, "a busy machine may be late for the last attempt, too"
    assert set(bodies) == {b'{"version":2,"expected":1,"reason":"better"}'}
    assert len({sent["idempotency-key"] for sent in headers}) == 1
    assert {sent["authorization"] for sent in headers} == {"Bearer plk_x"}
    assert {sent["x-request-timeout-ms"] for sent in headers} == {"300"}
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


@pytest.mark.parametrize(
    ("status", "expected"), [(429, Overloaded), (503, NotReady), (504, DeadlineExceeded), (DROP, RemoteError)]
)
def test_a_retry_deadline_of_zero_disables_retries(
    connect: Connect, server: Server, status: int, expected: type[Exception]
) -> None:
    server.prepare(status, then=ACTED)
    with pytest.raises(expected):
        connect(server.url, retry_deadline=0).act("board", [1])
    assert len(server.requests) == 1


def test_retry_after_beyond_the_deadline_ends_the_retries(connect: Connect, server: Server) -> None:
    server.prepare(429, then=ACTED, retry_after="60")
    with pytest.raises(Overloaded):
        connect(server.url, retry_deadline=30).act("board", [1])
    assert len(server.requests) == 1, "Retry-After exceeds the deadline"


def test_the_timeout_applies_to_each_attempt(connect: Connect, server: Server) -> None:
    server.prepare(NO_RESPONSE, NO_RESPONSE, then=ACTED)
    assert connect(server.url, timeout=0.2).act("board", [1]).action == 4  # on a busy machine, others time out, too
    assert len({body for body, _ in server.requests}) == 1


def reply(status: int, code: str | None = "x", **headers: str) -> httpx.Response:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    document = {"code": code, "message": "no"}
    return httpx.Response(status, headers=named, json=document if code else None)


@pytest.mark.parametrize(
    ("outcome", "is_repeated"),
    [
        (httpx.ConnectError("refused"), True),
        (httpx.ReadTimeout("late"), True),
        (httpx.RemoteProtocolError("hung up"), True),
        (reply(429), True),
        (reply(502), True),
        (reply(503), True),
        (reply(504), True),
        (reply(500, None), True),
        (reply(404, None), True),
        (reply(200), False),
        (reply(400), False),
        (reply(401), False),
        (reply(404), False),
        (reply(409), False),
        (reply(410), False),
        (reply(413), False),
        (reply(500), False),
        (reply(403, None), False),
    ],
    ids=str,
)
def test_which_outcomes_are_retried(outcome: Any, is_repeated: bool) -> None:
    assert (Retries(10).next_delay(outcome) is not None) == is_repeated
    assert Retries(0).next_delay(outcome) is None


def test_a_request_waits_longer_for_a_replica_than_for_a_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retries, "NOT_READY_DEADLINE", 1.0)
    monkeypatch.setattr(retries, "INITIAL_DELAY", 2.0)
    monkeypatch.setattr(retries, "JITTER", 0.0)
    assert Retries(10).next_delay(reply(503, "not_ready")) is None
    assert Retries(10).next_delay(reply(503, "no_replica")) is not None


def test_delays_grow_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(retries, "INITIAL_DELAY", 0.01)
    attempts = Retries(1e9)
    delays = [attempts.next_delay(httpx.ConnectError("refused")) or 0.0 for _ in range(12)]
    for number, delay in enumerate(delays):
        expected = min(0.01 * 2**number, 1.0)
        assert expected / 2 <= delay <= 1.5 * expected
    assert len(set(delays)) == 12, "delays have jitter"


def test_retry_after_is_a_lower_bound() -> None:
    assert (Retries(10).next_delay(reply(429, retry_after="3")) or 0) >= 3
    assert Retries(2).next_delay(reply(429, retry_after="3")) is None
    for invalid in ("soon", "-1", "1.5", ""):
        assert (Retries(10).next_delay(reply(429, retry_after=invalid)) or 9) < 1


def test_the_wait_of_a_rate_limit_is_reported(connect: Connect, server: Server) -> None:
    server.prepare(429, then=ACTED, retry_after="7")
    server.answers[0][1].update(code="rate_limited")
    with pytest.raises(RateLimited) as raised:
        connect(server.url, retry_deadline=1).act("board", [1])
    assert raised.value.wait == 7
