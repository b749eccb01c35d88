"""Event streams: their events, their end, and polling only with listeners."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack

import httpx
import pytest
from jsonschema import Draft202012Validator

from league.registry.registry import Registry
from league.registry.storage.rows import ChangeToken, EvaluationRow
from serve_app.app import Replica
from serve_app.openapi.document import document
from serve_app.routes import events
from serve_app.routes.events import EventBroker
from tests.support.clients.event_streams import LEAGUE, listen
from tests.support.leagues.served_leagues import promote
from tests.support.servers.replicas import QUICK
from tests.support.servers.streaming import Listening, listening
from tests.support.waiting import until

SOON = QUICK.model_copy(update={"poll_events": 0.02})


@pytest.fixture
def server(registry: Registry) -> Iterator[Listening]:
    with listening(registry.storage, SOON) as server:
        yield server


def test_a_stream_starts_with_the_current_state_and_reports_each_change(server: Listening, registry: Registry) -> None:
    with listen(server) as stream:
        assert stream.reply.headers["content-type"] == "text/event-stream; charset=utf-8"
        assert stream.reply.headers["cache-control"] == "no-store"
        assert [(name, state["aliases"]) for name, state in stream.events] == [("league", {"champion": 1})]
        promote(registry, "board", 3)
        until(lambda: stream.last["aliases"] == {"champion": 3})
        registry.traffic.set("board", canary=None, actor="test", reason="test")
        until(lambda: stream.last["traffic"] is not None)
        described = document(QUICK, [])
        schema = described["components"]["schemas"]["LeagueState"] | {"components": described["components"]}
        Draft202012Validator(schema).validate(stream.last)


def test_an_evaluation_is_reported_until_it_has_ended(server: Listening, registry: Registry) -> None:
    number = registry.evaluations.submit("board", {"kind": "tournament"}, actor="test", max_active=9).id
    path = f"/v1/leagues/board/evaluations/{number}"
    with listen(server, f"{path}/events") as stream, listen(server) as league:
        assert [(name, state["state"]) for name, state in stream.events] == [("evaluation", "queued")]
        assert registry.evaluations.claim("me", 1) is not None
        progress = {"what": "2 contestants", "played": 3, "of": 8}
        progress |= dict.fromkeys(("moves_per_second", "llr", "bounds"))
        registry.evaluations.heartbeat(number, "me", progress)
        until(lambda: stream.last["progress"] == progress)
        until(lambda: league.last["evaluations"] == [{"evaluation": number, "state": "running", "progress": progress}])
        registry.evaluations.finish(number, "me", "done", result={"games": 16})
        until(lambda: stream.is_over)
        assert stream.last == httpx.get(f"{server.url}{path}").json()
        assert (stream.last["state"], stream.last["result"]) == ("done", {"games": 16})
        until(lambda: league.last["evaluations"] == [])
        assert league.last["evaluation"] == number
    with listen(server, f"{path}/events") as again:
        until(lambda: again.is_over)
        assert len(again.events) == 1, "a finished evaluation has one event"


@pytest.mark.anyio
async def test_a_change_while_an_event_is_sent_is_reported_next(registry: Registry) -> None:
    broker = EventBroker(Replica(registry, QUICK, "replica-1").models, QUICK)
    states = iter([{"state": 1}, {"state": 2}])
    async with broker.subscribe("counter", lambda _: next(states)) as updates:
        assert await anext(updates) == {"state": 1}
        await broker._poll()  # the listener has not asked for the next event yet
        assert await anext(updates) == {"state": 2}


def test_all_listeners_share_a_poll_and_there_is_none_without_listeners(
    server: Listening, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    polls: list[str] = []
    changes = server.server.registry.changes
    token = changes.token

    def count_polls(league: str) -> ChangeToken:
        polls.append(league)
        return token(league)

    def wait_for_polls(league: str, times: int) -> None:
        polls.clear()
        until(lambda: polls.count(league) >= times)

    monkeypatch.setattr(changes, "token", count_polls)
    with listen(server, "/v1/leagues/memory/events"):
        with ExitStack() as stack:
            listeners = [stack.enter_context(listen(server)) for _ in range(5)]
            assert server.server.events.connections.open == 6
            wait_for_polls("memory", 10)
            assert polls.count("board") <= polls.count("memory") + 1
            promote(registry, "board", 2)
            until(lambda: all(listener.last["aliases"] == {"champion": 2} for listener in listeners))
        until(lambda: (server.server.events.connections.open, server.server.events.topics) == (1, 1))
        wait_for_polls("memory", 3)
        assert polls.count("board") <= 1, "a poll may have been in progress"
    until(lambda: (server.server.events.connections.open, server.server.events.topics) == (0, 0))


def test_the_stream_of_a_removed_league_ends_and_the_others_go_on(server: Listening, registry: Registry) -> None:
    with listen(server) as board, listen(server, "/v1/leagues/memory/events") as memory:
        registry.removal.remove_league("memory", force=True)
        until(lambda: memory.is_over)
        promote(registry, "board", 3)
        until(lambda: board.last["aliases"] == {"champion": 3})
        assert server.server.events.topics == 1
        with listen(server, "/v1/leagues/memory/events") as again:
            assert again.reply.status_code == 404


def test_a_state_that_cannot_be_sent_is_an_error_and_ends_its_streams_only(
    server: Listening, registry: Registry
) -> None:
    number = registry.evaluations.submit("board", {"kind": "tournament"}, actor="test", max_active=9).id
    path = f"/v1/leagues/board/evaluations/{number}/events"
    with listen(server, path) as evaluation, listen(server) as board:
        with registry.database.write() as session:
            session.get_one(EvaluationRow, number).request = {"kind": "tournament", "games": 2**70}
        until(lambda: evaluation.is_over)
        with listen(server, path) as again:
            assert again.reply.status_code == 500
        promote(registry, "board", 3)
        until(lambda: board.last["aliases"] == {"champion": 3})


def test_the_number_of_listeners_is_limited(registry: Registry) -> None:
    with listening(registry.storage, SOON.model_copy(update={"max_listeners": 1})) as server:
        with listen(server), listen(server) as rejected:
            assert (rejected.reply.status_code, rejected.reply.headers["retry-after"]) == (429, "1")
        until(lambda: server.server.events.connections.open == 0)
        with listen(server) as stream:
            assert stream.reply.status_code == 200


def test_an_unknown_resource_is_reported_before_a_stream_starts(server: Listening) -> None:
    for path, status, code in (
        ("/v1/leagues/nobody/events", 404, "unknown_league"),
        ("/v1/leagues/NO/events", 400, "invalid_reference"),
        ("/v1/leagues/board/evaluations/7/events", 404, "unknown_evaluation"),
        ("/v1/leagues/board/evaluations/x/events", 404, "unknown_evaluation"),
    ):
        reply = httpx.get(f"{server.url}{path}")
        assert (reply.status_code, reply.json()["code"]) == (status, code), path
        assert server.server.events.connections.open == 0
    reply = httpx.head(f"{server.url}{LEAGUE}")
    assert (reply.status_code, reply.headers["content-type"]) == (200, "text/event-stream; charset=utf-8")
    server.server.events.end()
    reply = httpx.get(f"{server.url}{LEAGUE}")
    assert (reply.status_code, reply.json()["code"]) == (503, "not_ready")


def test_the_timeout_of_requests_does_not_apply_to_streams(
    server: Listening, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "KEEPALIVE_INTERVAL", 0.05)
    with listen(server, **{"x-request-timeout-ms": "1"}) as stream:
        for version in (2, 3, 1):
            promote(registry, "board", version)
            until(lambda version=version: stream.last["aliases"] == {"champion": version})
        until(lambda: stream.lines.count(": keep-alive") > 3)
        assert not stream.is_over


def test_a_stopping_replica_ends_its_streams(server: Listening) -> None:
    with listen(server) as stream:
        server.drain()
        until(lambda: stream.is_over)
        with pytest.raises(httpx.TransportError):
            httpx.get(f"{server.url}{LEAGUE}")


def test_a_registry_that_does_not_respond_times_out(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = threading.Event()
    with listening(registry.storage, SOON.model_copy(update={"timeout": 0.05})) as server:
        monkeypatch.setattr(server.server.registry.changes, "token", lambda _: answer.wait(60))
        reply = httpx.get(f"{server.url}{LEAGUE}", timeout=60)
        answer.set()
        assert (reply.status_code, reply.json()["code"]) == (504, "deadline_exceeded")
        until(lambda: server.server.events.connections.open == 0)


def test_a_stream_ends_with_its_key(server: Listening, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "KEEPALIVE_INTERVAL", 0.05)
    with listen(server) as without:
        keys = [registry.keys.create(name, ["read"])[1] for name in ("page", "other")]
        until(lambda: without.is_over)  # keys are required now
    with listen(server, **{"x-api-key": keys[0]}) as stream, listen(server, **{"x-api-key": keys[1]}) as unaffected:
        assert stream.reply.status_code == 200
        registry.keys.revoke("page")
        until(lambda: stream.is_over)
        before = len(unaffected.lines)
        until(lambda: len(unaffected.lines) > before)
    with listen(server) as stranger:
        assert stranger.reply.status_code == 401


def test_streams_survive_a_temporarily_missing_database(
    server: Listening, registry: Registry, caplog: pytest.LogCaptureFixture
) -> None:
    home = registry.storage.home
    with listen(server) as stream:
        home.rename(home.with_name("elsewhere"))
        until(lambda: "cannot poll event streams" in caplog.text)
        home.with_name("elsewhere").rename(home)
        promote(registry, "board", 2)
        until(lambda: stream.last["aliases"] == {"champion": 2})
