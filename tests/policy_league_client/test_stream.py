"""The client's streams and episodes keep their version, and continue on another replica or report that it is gone."""

import asyncio
import json
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from websockets.sync.server import ServerConnection, serve

from league import errors
from league.registry.registry import Registry
from policy_league_client import AsyncClient
from serve_app.runtime.haproxy import free_ports
from serve_app.runtime.uvicorn_websocket import StreamWebSocketProtocol
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
    """An error does not end it."""
    with connect(url).stream("memory") as stream:
        assert [stream.act(ONE) for _ in range(3)] == [0, 0, 1]
        assert [stream.act(ONE, reset=True), stream.act(ONE), stream.act(ONE)] == [0, 0, 1]
        batch = np.array([[1], [2]], np.float32)
        with pytest.raises(errors.InvalidState, match="a reset is required"):
            stream.act_batch(batch)
        with pytest.raises(errors.InvalidInput):
            stream.act(object())
        assert stream.act_batch(batch, reset=True) == [0, 0]
        assert stream.act_batch(batch) == [0, 1]
        assert stream.act_batch(batch, reset=[False, True]) == [1, 0]


def test_what_cannot_start_raises(connect: Connect, url: str) -> None:
    client = connect(url, retry_deadline=0.2)
    for start, model, expected in (
        (client.stream, "nobody", errors.UnknownLeague),
        (client.stream, "headless", errors.NotReady),
        (client.episode, "nobody", errors.UnknownLeague),
        (client.episode, "board@99", errors.UnknownVersion),
        (client.episode, "a.b.c", errors.InvalidReference),
    ):
        with pytest.raises(expected) as raised, start(model) as acting:
            acting.act(BOARD)
        assert type(raised.value) is expected
    with (
        pytest.raises(errors.RemoteError, match="stream: "),
        connect(NO_SERVER, retry_deadline=0.1).stream("a") as stream,
    ):
        stream.act(BOARD)
    with connect(url).stream("choice") as stream, pytest.raises(errors.BodyTooLarge):
        stream.act(np.zeros(SETTINGS.max_body, np.int8))


def abort_streams(listener: Listening) -> None:
    """End all streams without a closing handshake, as when the process dies."""
    for connection in list(listener.uvicorn.server_state.connections):
        if isinstance(connection, StreamWebSocketProtocol):
            connection.loop.call_soon_threadsafe(connection.transport.abort)


@pytest.mark.parametrize("is_warned", [True, False], ids=["drained", "died"])
def test_streams_and_episodes_continue_on_another_replica_unless_their_version_is_gone(
    connect: Connect, registry: Registry, is_warned: bool
) -> None:
    (port,) = free_ports(1, "127.0.0.1")
    with listening(registry.storage, port=port) as first:
        client = connect(first.url)
        one, two = client.stream("memory"), client.stream("memory", follow=True)
        pinned, following = client.stream("board"), client.stream("board", follow=True)
        episode, lost = client.episode("memory"), (client.episode("board@3"), client.stream("board@3"))
        assert (pinned.version, pinned.last) == (None, None)
        assert [one.act(ONE) for _ in range(2)] == [0, 0]
        assert two.act_batch([ONE, 2 * ONE]) == [0, 0]
        assert [episode.act(ONE) for _ in range(2)] == [0, 0]
        for acting in (pinned, following, *lost):
            acting.act(BOARD)
        promote(registry, "board", 2)
        if not is_warned:
            abort_streams(first)
            assert one.act(ONE) == 1, "a reconnection to the same replica works too"
    shutil.rmtree(registry.artifacts.path("board", 3))
    with listening(registry.storage, replica="replica-2", port=port):
        assert one.act(ONE) == episode.act(ONE) == 1
        assert two.act_batch([ONE, ONE], reset=[True, False]) == [0, 1]
        for stream, version in ((pinned, 1), (following, 2)):
            stream.act(BOARD)
            assert stream.version == version
        for acting in (one, two, pinned, following, episode):
            assert acting.last.replica == "replica-2"
        for acting, reason in zip(lost, ("cannot continue after 1 actions of board@3", "board@3"), strict=True):
            with pytest.raises(errors.VersionRetired, match=reason):
                acting.act(BOARD)
        for stream in (one, two, pinned, following):
            stream.close()


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


@contextmanager
def serving(respond: Callable[[ServerConnection], None], **head: str) -> Iterator[str]:
    """The URL of a server whose handshakes have more headers."""

    def add_headers(_: ServerConnection, __: Any, response: Any) -> None:
        response.headers.update(head)

    with serve(respond, "127.0.0.1", 0, process_response=add_headers) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
    thread.join()


VERSION = {"x-league-version": "1"}


@pytest.fixture
def slow() -> Iterator[tuple[Slow, str]]:
    handler = Slow()
    with serving(handler, **VERSION) as url:
        yield handler, url
        handler.respond.set()


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
        with pytest.raises(errors.RemoteError, match="lost"):
            stream.act(BOARD)
        assert len(handler.received) == 1


def test_another_kind_of_server_is_reported(connect: Connect) -> None:
    for head, body, message in (
        ({}, "{}", "contains no version"),
        (VERSION, "<html>", "did not return a JSON object"),
        (VERSION, "[1]", "did not return a JSON object"),
    ):

        def respond(connection: ServerConnection, body: str = body) -> None:
            for _ in connection:
                connection.send(body)

        with (
            serving(respond, **head) as url,
            pytest.raises(errors.RemoteError, match=message),
            connect(url).stream("board") as stream,
        ):
            stream.act(BOARD)


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


def test_an_episode_keeps_its_version_across_promotions(
    connect: Connect, registry: Registry, listener: Listening
) -> None:
    client = connect(listener.url)
    registry.aliases.set("board", "candidate", 3, expected=None, actor="test", reason="test")
    with client.episode("board") as episode, client.episode("board@candidate") as of_alias:
        assert (episode.version, episode.last, episode.steps) == (None, None, 0)
        first, _ = episode.act(BOARD), of_alias.act(BOARD)
        promote(registry, "board", 2)
        registry.aliases.set("board", "candidate", 1, expected=3, actor="test", reason="test")
        until(lambda: client.act("board", BOARD).version == 2)
        assert [episode.act(BOARD) for _ in range(3)] == [first] * 3
        of_alias.act(BOARD)
        assert (episode.version, episode.steps, episode.last.version, of_alias.version) == (1, 4, 1, 3)
    with client.episode("board") as episode:
        episode.act(BOARD)
        assert episode.version == 2


def test_an_episode_carries_its_recurrent_state(connect: Connect, url: str) -> None:
    client = connect(url)
    with client.episode("memory") as one, client.episode("memory") as other:
        assert [one.act(ONE) for _ in range(4)] == [0, 0, 1, 1]
        assert [other.act(ONE) for _ in range(3)] == [0, 0, 1]


def test_an_exploring_episode_is_reproducible(connect: Connect, url: str) -> None:
    def play(seed: int | None) -> list[int]:
        with connect(url).episode("board", explore=True, seed=seed) as episode:
            return [episode.act(BOARD) for _ in range(30)]

    assert play(1) == play(1) != play(2)
    assert len(set(play(1))) > 1
    assert play(None) != play(None)
    with connect(url).episode("board", explore=True, seed=1) as episode:
        action = episode.act(BOARD, probabilities=True)
        assert episode.last is not None
        assert episode.last.probabilities[action] > 0
        alone = connect(url).act("board@1", BOARD, explore=True, seed=episode.last.seed)
        assert alone.action == action
