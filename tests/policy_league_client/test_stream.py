"""The client's streams: actions equal those of calls, and a lost connection continues on another replica."""

import asyncio
import json
import shutil
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from websockets.sync.server import Server, ServerConnection, serve

from league.errors import (
    BodyTooLarge,
    InvalidInput,
    InvalidState,
    NotReady,
    ObservationError,
    RemoteError,
    UnknownLeague,
    VersionRetired,
)
from league.registry.registry import Registry
from policy_league_client import AsyncClient
from serve_app.runtime.haproxy import free_ports
from tests.support.clients.actions import BOARD, boards
from tests.support.clients.sync_and_async import SETTINGS, Connect
from tests.support.leagues.served_leagues import promote
from tests.support.servers.streaming import Listening, listening
from tests.support.waiting import until

ONE = np.ones(1, np.float32)
NO_SERVER = "http://127.0.0.1:9"


def test_a_stream_returns_the_actions_of_calls(connect: Connect, url: str) -> None:
    client, observations = connect(url), boards(8)
    response = client.act_batch("board@2", observations, explore=False)
    with client.stream("board@2") as stream:
        assert stream.version == 2
        assert [stream.act(board, explore=False) for board in observations] == response.actions
        assert stream.last == response.response(7)
        assert stream.act_batch(observations, explore=False) == response.actions
        assert stream.last == response
        drawn = stream.act(observations[0], explore=True, seed=7, probabilities=True)
        alone = client.act("board@2", observations[0], explore=True, seed=7, probabilities=True)
        assert (drawn, stream.last.seed) == (alone.action, 7)
        np.testing.assert_array_equal(stream.last.probabilities, alone.probabilities)
    with client.stream("vector") as stream:
        vector = stream.act(np.array([0.5, -1], np.float32))
        assert (vector.tolist(), vector.dtype) == ([0.5, -1], np.float32)


def test_a_stream_keeps_recurrent_state_until_a_reset(connect: Connect, url: str) -> None:
    with connect(url).stream("memory") as stream:
        assert [stream.act(ONE) for _ in range(3)] == [0, 0, 1]
        assert [stream.act(ONE, reset=True), stream.act(ONE), stream.act(ONE)] == [0, 0, 1]
        batch = np.array([[1], [2]], np.float32)
        with pytest.raises(InvalidState, match="a reset is required"):
            stream.act_batch(batch)
        assert stream.act_batch(batch, reset=True) == [0, 0]
        assert stream.act_batch(batch) == [0, 1]
        assert stream.act_batch(batch, reset=[False, True]) == [1, 0]


def test_an_error_does_not_end_a_stream(connect: Connect, url: str) -> None:
    with connect(url).stream("board") as stream:
        first = stream.act(BOARD)
        with pytest.raises(ObservationError, match="expected"):
            stream.act({"observation": np.zeros(3, np.int8), "action_mask": np.ones(7, np.int8)})
        with pytest.raises(InvalidInput):
            stream.act({"observation": object()})
        assert stream.act(BOARD) == first


@pytest.mark.parametrize(("model", "expected"), [("nobody", UnknownLeague), ("headless", NotReady)])
def test_a_stream_that_cannot_be_opened_raises(
    connect: Connect, url: str, model: str, expected: type[Exception]
) -> None:
    with pytest.raises(expected) as raised, connect(url, retry_deadline=0.2).stream(model) as stream:
        stream.act(BOARD)
    assert type(raised.value) is expected


def test_a_stream_to_an_unreachable_server_raises(connect: Connect) -> None:
    with (
        pytest.raises(RemoteError, match="stream: "),
        connect("http://127.0.0.1:9", retry_deadline=0.1).stream("a") as stream,
    ):
        stream.act(BOARD)


def test_a_message_that_is_too_large_is_not_retried(connect: Connect, url: str) -> None:
    with connect(url).stream("choice") as stream, pytest.raises(BodyTooLarge):
        stream.act(np.zeros(SETTINGS.max_body, np.int8))


def test_a_stream_is_pinned_or_follows_its_alias(connect: Connect, registry: Registry, listener: Listening) -> None:
    client = connect(listener.url)
    registry.aliases.set("board", "candidate", 3, expected=None, actor="test", reason="test")
    with (
        client.stream("board") as pinned,
        client.stream("board", follow=True) as following,
        client.stream("board@candidate", follow=True) as candidate,
    ):
        assert (pinned.version, pinned.last) == (None, None)
        for stream in (pinned, following, candidate):
            stream.act(BOARD)
        assert [stream.version for stream in (pinned, following, candidate)] == [1, 1, 3]
        promote(registry, "board", 2)
        until(lambda: following.act(BOARD) is not None and following.version == 2)
        for stream in (pinned, candidate):
            stream.act(BOARD)
        assert [stream.version for stream in (pinned, candidate)] == [1, 3]


def abort_connections(listener: Listening) -> None:
    """End all connections without a closing handshake, as when the process dies."""
    for connection in list(listener.uvicorn.server_state.connections):
        connection.loop.call_soon_threadsafe(connection.transport.abort)


@pytest.mark.parametrize("is_warned", [True, False], ids=["drained", "died"])
@pytest.mark.parametrize("follow", [True, False], ids=["following", "pinned"])
def test_a_stream_continues_on_another_replica(
    connect: Connect, registry: Registry, is_warned: bool, follow: bool
) -> None:
    (port,) = free_ports(1, "127.0.0.1")
    with listening(registry.storage, port=port) as first:
        client = connect(first.url)
        one, two = client.stream("memory", follow=follow), client.stream("memory", follow=follow)
        pinned = client.stream("board", follow=follow)
        assert [one.act(ONE) for _ in range(2)] == [0, 0]
        assert two.act_batch([ONE, 2 * ONE]) == [0, 0]
        pinned.act(BOARD)
        promote(registry, "board", 2)
        if not is_warned:
            abort_connections(first)
            assert one.act(ONE) == 1, "a reconnection to the same replica works too"
    with listening(registry.storage, replica="replica-2", port=port):
        assert one.act(ONE) == 1
        assert two.act_batch([ONE, ONE], reset=[True, False]) == [0, 1]
        pinned.act(BOARD)
        assert pinned.version == (2 if follow else 1)
        assert {stream.last.replica for stream in (one, two, pinned)} == {"replica-2"}
        for stream in (one, two, pinned):
            stream.close()


def test_a_stream_whose_version_was_removed_raises(connect: Connect, registry: Registry) -> None:
    (port,) = free_ports(1, "127.0.0.1")
    with listening(registry.storage, port=port) as first:
        stream = connect(first.url).stream("board@3")
        stream.act(BOARD)
    shutil.rmtree(registry.artifacts.path("board", 3))
    with listening(registry.storage, port=port), pytest.raises(VersionRetired):
        stream.act(BOARD)


class Slow:
    """A server that answers each message with its number, the first one only when `respond` is set, or never: then it
    hangs up.
    """

    def __init__(self) -> None:
        self.received: list[dict[str, Any]] = []
        self.respond = threading.Event()
        self.hangs_up = False

    def __call__(self, connection: ServerConnection) -> None:
        for message in connection:
            self.received.append(json.loads(message))
            number = len(self.received)
            if number == 1 and self.hangs_up:
                return
            if number == 1:
                self.respond.wait()
            connection.send(json.dumps({"action": number, "model": "board", "version": 1, "sha256": "0"}))


@pytest.fixture
def slow() -> Iterator[tuple[Slow, str]]:
    handler = Slow()

    def add_headers(connection: ServerConnection, _: Any, response: Any) -> None:
        response.headers["x-league-version"] = "1"

    server: Server
    with serve(handler, "127.0.0.1", 0, process_response=add_headers) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield handler, f"http://127.0.0.1:{server.socket.getsockname()[1]}"
        handler.respond.set()
        server.shutdown()
    thread.join()


def test_a_late_answer_is_not_taken_for_the_next_one(connect: Connect, slow: tuple[Slow, str]) -> None:
    """On a busy machine, others than the first message may be late and sent again, too."""
    handler, url = slow
    with connect(url, timeout=0.2).stream("board") as stream:
        assert stream.act(BOARD, explore=True) > 1, "retried over another connection"
        assert all(message == handler.received[0] for message in handler.received), "retries have the same seed"
        handler.respond.set()
        for seed in (7, 8):
            assert handler.received[stream.act(BOARD, explore=True, seed=seed) - 1]["seed"] == seed


def test_a_retry_deadline_of_zero_disables_retries(connect: Connect, slow: tuple[Slow, str]) -> None:
    handler, url = slow
    handler.hangs_up = True
    with connect(url, retry_deadline=0).stream("board") as stream:
        with pytest.raises(RemoteError, match="lost"):
            stream.act(BOARD)
        assert len(handler.received) == 1


@pytest.mark.parametrize(("head", "body"), [({}, "{}"), ({"x-league-version": "1"}, "<html>")], ids=["header", "body"])
def test_another_kind_of_server_is_reported(connect: Connect, head: dict[str, str], body: str) -> None:
    def add_headers(_: ServerConnection, __: Any, response: Any) -> None:
        response.headers.update(head)

    def respond(connection: ServerConnection) -> None:
        for _ in connection:
            connection.send(body)

    with serve(respond, "127.0.0.1", 0, process_response=add_headers) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        url = f"http://127.0.0.1:{server.socket.getsockname()[1]}"
        with (
            pytest.raises(RemoteError, match=r"contains no version|did not return JSON"),
            connect(url).stream("board") as stream,
        ):
            stream.act(BOARD)
        server.shutdown()
    thread.join()


def test_a_cancelled_action_leaves_no_answer_behind(slow: tuple[Slow, str]) -> None:
    handler, url = slow

    async def cancel() -> list[int]:
        async with AsyncClient(url) as client, client.stream("board") as stream:
            action = asyncio.create_task(stream.act(BOARD))
            while not handler.received:
                await asyncio.sleep(0.01)
            action.cancel()
            handler.respond.set()
            await asyncio.wait([action])
            assert action.cancelled()
            return [await stream.act(BOARD) for _ in range(2)]

    assert asyncio.run(cancel()) == [2, 3]
