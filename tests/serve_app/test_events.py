"""Streams of events: what is told, to whom, for how long, and what it costs where nobody listens."""

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import httpx
import pytest
from jsonschema import Draft202012Validator

from league.registry.registry import Registry
from league.registry.rows import Pulse
from serve_app import events
from serve_app.openapi.document import document
from tests.evaluation.waiting import until
from tests.serve_app.conftest import QUICK
from tests.serve_app.leagues import promote
from tests.serve_app.streaming import Listening, listening

LEAGUE = "/v1/leagues/board/events"
SOON = QUICK.model_copy(update={"poll_events": 0.02})


class Heard:
    """What came of a stream so far: `status`, then the lines; `is_over` when no more will."""

    def __init__(self, reply: httpx.Response) -> None:
        self.reply = reply
        self.lines: list[str] = []
        self.is_over = False
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        with suppress(httpx.HTTPError):
            self.lines.extend(self.reply.iter_lines())
        self.is_over = True

    def leave(self) -> None:
        """Hang up, if the server has not."""
        with suppress(OSError):
            self.reply.extensions["network_stream"].get_extra_info("socket").shutdown(socket.SHUT_RDWR)
        self._thread.join()

    @property
    def events(self) -> list[tuple[str, dict[str, Any]]]:
        """Name and document of each event that is whole."""
        lines = list(self.lines)
        names = [at for at, line in enumerate(lines[:-1]) if line.startswith("event: ")]
        return [(lines[at].removeprefix("event: "), json.loads(lines[at + 1].removeprefix("data: "))) for at in names]

    @property
    def last(self) -> dict[str, Any]:
        return self.events[-1][1]


@contextmanager
def listener(server: Listening | str, path: str = LEAGUE, **headers: str) -> Iterator[Heard]:
    """Listens while the context lasts, which begins with the first event, or with a refusal."""
    base = server if isinstance(server, str) else server.url
    with httpx.stream("GET", f"{base}{path}", headers=headers, timeout=60) as reply:
        heard = Heard(reply)
        try:
            until(lambda: bool(heard.events) or heard.is_over)
            yield heard
        finally:
            heard.leave()


@pytest.fixture
def server(registry: Registry) -> Iterator[Listening]:
    with listening(registry.storage, SOON) as server:
        yield server


def test_a_stream_begins_with_what_there_is_and_tells_each_change(server: Listening, registry: Registry) -> None:
    with listener(server) as heard:
        assert heard.reply.headers["content-type"] == "text/event-stream; charset=utf-8"
        assert heard.reply.headers["cache-control"] == "no-store"
        assert [(name, found["aliases"]) for name, found in heard.events] == [("league", {"champion": 1})]
        promote(registry, "board", 3)
        until(lambda: heard.last["aliases"] == {"champion": 3})
        registry.set_traffic("board", canary=None, actor="test", reason="test")
        until(lambda: heard.last["traffic"] is not None)
        described = document(QUICK, [])
        pulse = described["components"]["schemas"]["Pulse"] | {"components": described["components"]}
        Draft202012Validator(pulse).validate(heard.last)


def test_an_evaluation_is_told_until_it_has_ended(server: Listening, registry: Registry) -> None:
    number = registry.ask_evaluation("board", {"kind": "tournament"}, actor="test", most=9).id
    place = f"/v1/leagues/board/evaluations/{number}"
    with listener(server, f"{place}/events") as heard, listener(server) as league:
        assert [(name, found["state"]) for name, found in heard.events] == [("evaluation", "queued")]
        assert registry.claim_evaluation("me", 1) is not None
        progress = {"what": "2 contestants", "played": 3, "of": 8, "llr": None, "bounds": None}
        registry.beat_evaluation(number, "me", progress)
        until(lambda: heard.last["progress"] == progress)
        until(lambda: league.last["evaluations"] == [{"evaluation": number, "state": "running", "progress": progress}])
        registry.finish_evaluation(number, "me", "done", result={"games": 16})
        until(lambda: heard.is_over)
        assert heard.last == httpx.get(f"{server.url}{place}").json()
        assert (heard.last["state"], heard.last["result"]) == ("done", {"games": 16})
        until(lambda: league.last["evaluations"] == [])
        assert league.last["evaluation"] == number
    with listener(server, f"{place}/events") as again:
        until(lambda: again.is_over)
        assert len(again.events) == 1, "of what has ended there is no more to tell"


def test_where_nothing_changes_it_says_that_it_is_there(server: Listening, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "SILENCE", 0.01)
    with listener(server) as heard:
        until(lambda: heard.lines.count(": nothing new") > 3)


def test_all_listeners_share_one_look_and_without_them_nobody_looks(
    server: Listening, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[str] = []
    pulse = Registry.pulse

    def counted(self: Registry, league: str, **options: Any) -> Pulse:
        looks.append(league)
        return pulse(self, league, **options)

    def looked(league: str, times: int) -> None:
        looks.clear()
        until(lambda: looks.count(league) >= times)

    monkeypatch.setattr(Registry, "pulse", counted)
    with listener(server, "/v1/leagues/memory/events"):
        with ExitStack() as stack:
            heard = [stack.enter_context(listener(server)) for _ in range(5)]
            assert server.server.events.open == 6
            looked("memory", 10)
            assert looks.count("board") <= 11
            promote(registry, "board", 2)
            until(lambda: all(each.last["aliases"] == {"champion": 2} for each in heard))
        until(lambda: server.server.events.subjects == 1)
        looked("memory", 3)
        assert looks.count("board") <= 1, "a look that was under way"


def test_those_who_are_too_many_are_told_to_come_back(registry: Registry) -> None:
    with listening(registry.storage, SOON.model_copy(update={"max_listeners": 1})) as server:
        with listener(server), listener(server) as refused:
            assert (refused.reply.status_code, refused.reply.headers["retry-after"]) == (429, "1")
        until(lambda: server.server.events.open == 0)
        with listener(server) as heard:
            assert heard.reply.status_code == 200


@pytest.mark.parametrize(
    ("path", "status", "code"),
    [
        ("/v1/leagues/nobody/events", 404, "unknown_league"),
        ("/v1/leagues/NO/events", 400, "invalid_reference"),
        ("/v1/leagues/board/evaluations/7/events", 404, "unknown_evaluation"),
        ("/v1/leagues/board/evaluations/x/events", 404, "unknown_evaluation"),
    ],
)
def test_what_is_not_there_is_said_before_a_stream_begins(server: Listening, path: str, status: int, code: str) -> None:
    reply = httpx.get(f"{server.url}{path}")
    assert (reply.status_code, reply.json()["code"]) == (status, code)
    assert server.server.events.open == 0


def test_a_head_is_answered_at_once(server: Listening) -> None:
    reply = httpx.head(f"{server.url}{LEAGUE}")
    assert (reply.status_code, reply.headers["content-type"]) == (200, "text/event-stream; charset=utf-8")


def test_the_deadline_of_requests_is_not_that_of_a_stream(registry: Registry) -> None:
    with (
        listening(registry.storage, SOON.model_copy(update={"timeout": 0.5})) as server,
        listener(server, **{"x-request-timeout-ms": "1"}) as heard,
    ):
        for version in (2, 3, 1):
            promote(registry, "board", version)
            until(lambda version=version: heard.last["aliases"] == {"champion": version})
        until(lambda: heard.lines.count(": nothing new") > 0)
        assert not heard.is_over


def test_a_replica_that_stops_ends_its_streams(registry: Registry) -> None:
    with listening(registry.storage, SOON) as server, listener(server) as heard:
        server.drain()
        until(lambda: heard.is_over)
        with pytest.raises(httpx.TransportError):
            httpx.get(f"{server.url}{LEAGUE}")


def test_a_replica_that_stops_begins_no_stream(server: Listening) -> None:
    server.server.events.end()
    reply = httpx.get(f"{server.url}{LEAGUE}")
    assert (reply.status_code, reply.json()["code"]) == (503, "not_ready")


def test_a_registry_that_does_not_answer_is_not_waited_for(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = threading.Event()
    monkeypatch.setattr(Registry, "pulse", lambda *_, **__: answer.wait(20))
    with listening(registry.storage, SOON.model_copy(update={"timeout": 0.05})) as server:
        reply = httpx.get(f"{server.url}{LEAGUE}")
        answer.set()
        assert (reply.status_code, reply.json()["code"]) == (504, "deadline_exceeded")
        assert server.server.events.open == 0


def test_a_stream_ends_with_its_key(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "SILENCE", 0.05)
    _, token = registry.create_key("page", ["read"])
    _, other = registry.create_key("other", ["read"])
    with listening(registry.storage, SOON) as server:
        with listener(server, **{"x-api-key": token}) as heard, listener(server, **{"x-api-key": other}) as stays:
            assert heard.reply.status_code == 200
            registry.revoke_key("page")
            until(lambda: heard.is_over)
            before = len(stays.lines)
            until(lambda: len(stays.lines) > before)
        with listener(server) as stranger:
            assert stranger.reply.status_code == 401


def test_a_stream_without_a_key_ends_when_there_is_one(
    server: Listening, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "SILENCE", 0.05)
    with listener(server) as heard:
        registry.create_key("first", ["read"])
        until(lambda: heard.is_over)


def test_a_database_that_is_gone_for_a_while_ends_no_stream(
    server: Listening, registry: Registry, caplog: pytest.LogCaptureFixture
) -> None:
    home = registry.storage.home
    with listener(server) as heard:
        home.rename(home.with_name("elsewhere"))
        until(lambda: "what is listened to cannot be followed" in caplog.text)
        home.with_name("elsewhere").rename(home)
        promote(registry, "board", 2)
        until(lambda: heard.last["aliases"] == {"champion": 2})


def test_who_leaves_is_forgotten(server: Listening) -> None:
    with ExitStack() as stack:
        for path in (LEAGUE, LEAGUE, "/v1/leagues/memory/events"):
            stack.enter_context(listener(server, path))
        assert (server.server.events.open, server.server.events.subjects) == (3, 2)
    until(lambda: (server.server.events.open, server.server.events.subjects) == (0, 0))
