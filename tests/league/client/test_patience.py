"""When a call is made again, and what it is then: the same one, to the last byte."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import httpx
import pytest

from league.client import patience
from league.client.patience import Attempts
from league.errors import DeadlineExceeded, NotReady, Overloaded, RateLimited, RemoteError
from tests.league.client.conftest import Connect

DROP, MUTE = 0, 1
"""In place of a status: hang up without an answer, say nothing."""
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
    """Gives the prepared answers one after the other, and the last one for ever."""

    def __init__(self) -> None:
        self.answers: list[tuple[int, dict[str, Any], dict[str, str]]] = []
        self.asked: list[tuple[bytes, dict[str, str]]] = []
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
                server.asked.append((body, {name.lower(): value for name, value in self.headers.items()}))
                status, document, headers = server.answers.pop(0) if len(server.answers) > 1 else server.answers[0]
                if status == MUTE:
                    server.is_over.wait(30)
                if status in (DROP, MUTE):
                    self.close_connection = True
                    return
                answer = json.dumps(document).encode()
                self.send_response(status)
                for name, value in {"content-length": str(len(answer)), **headers}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(answer)

            def log_message(self, *_: Any) -> None:
                """Say nothing."""

        return Handler


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    listener = ThreadingHTTPServer(("127.0.0.1", 0), server.handler())
    server.url = f"http://127.0.0.1:{listener.server_port}"  # type: ignore[attr-defined]
    thread = threading.Thread(target=listener.serve_forever, daemon=True)
    thread.start()
    yield server
    server.is_over.set()
    listener.shutdown()
    listener.server_close()


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "FIRST", 0.001)


def test_a_promotion_is_repeated_under_the_same_idempotency_key(connect: Connect, server: Server) -> None:
    server.prepare(DROP, 503, 500, MUTE, then=MOVED)
    server.answers[2] = (500, {"told": "by HAProxy"}, {})
    server.answers[2:3] = []  # what a server of ours says of a bug is final
    client = connect(server.url, key="plk_x", timeout=0.3)
    assert client.promote("board@2", expected=1, reason="better").event == 3
    bodies, headers = zip(*server.asked, strict=True)
    assert len(bodies) == 4
    assert set(bodies) == {b'{"version":2,"expected":1,"reason":"better"}'}
    assert len({sent["idempotency-key"] for sent in headers}) == 1
    assert {sent["authorization"] for sent in headers} == {"Bearer plk_x"}
    assert {sent["x-request-timeout-ms"] for sent in headers} == {"300"}
    client.promote("board@2", idempotency_key="mine")
    assert server.asked[-1][1]["idempotency-key"] == "mine"
    client.rollback("board")
    assert len({sent["idempotency-key"] for _, sent in server.asked}) == 3, "each call has one of its own"


def test_what_is_drawn_does_not_change_by_asking_again(connect: Connect, server: Server) -> None:
    server.prepare(DROP, 429, 504, then=ACTED, retry_after="0")
    answer = connect(server.url).act("board", [1], explore=True)
    bodies = {body for body, _ in server.asked}
    assert len(server.asked) == 4
    assert [json.loads(body)["seed"] for body in bodies] == [answer.seed]


@pytest.mark.parametrize(
    ("status", "expected"), [(429, Overloaded), (503, NotReady), (504, DeadlineExceeded), (DROP, RemoteError)]
)
def test_no_patience_is_no_second_attempt(
    connect: Connect, server: Server, status: int, expected: type[Exception]
) -> None:
    server.prepare(status, then=ACTED)
    with pytest.raises(expected):
        connect(server.url, patience=0).act("board", [1])
    assert len(server.asked) == 1


def test_a_busy_server_is_left_alone_for_as_long_as_it_asks(connect: Connect, server: Server) -> None:
    server.prepare(429, then=ACTED, retry_after="60")
    with pytest.raises(Overloaded):
        connect(server.url, patience=30).act("board", [1])
    assert len(server.asked) == 1, "it will not be ready while we wait"


def test_a_timeout_is_of_one_attempt(connect: Connect, server: Server) -> None:
    server.prepare(MUTE, MUTE, then=ACTED)
    assert connect(server.url, timeout=0.2).act("board", [1]).action == 4
    assert len(server.asked) == 3


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
def test_what_is_worth_another_attempt(outcome: Any, is_repeated: bool) -> None:
    assert (Attempts(10).pause(outcome) is not None) == is_repeated
    assert Attempts(0).pause(outcome) is None


def test_pauses_grow_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "FIRST", 0.01)
    attempts = Attempts(1e9)
    pauses = [attempts.pause(httpx.ConnectError("refused")) or 0.0 for _ in range(12)]
    for number, pause in enumerate(pauses):
        usual = min(0.01 * 2**number, 1.0)
        assert usual / 2 <= pause <= 1.5 * usual
    assert len(set(pauses)) == 12, "so that clients spread"


def test_retry_after_is_the_least() -> None:
    assert (Attempts(10).pause(reply(429, retry_after="3")) or 0) >= 3
    assert Attempts(2).pause(reply(429, retry_after="3")) is None
    for nonsense in ("soon", "-1", "1.5", ""):
        assert (Attempts(10).pause(reply(429, retry_after=nonsense)) or 9) < 1


def test_a_rate_s_wait_is_told(connect: Connect, server: Server) -> None:
    server.prepare(429, then=ACTED, retry_after="7")
    server.answers[0][1].update(code="rate_limited")
    with pytest.raises(RateLimited) as raised:
        connect(server.url, patience=1).act("board", [1])
    assert raised.value.wait == 7
