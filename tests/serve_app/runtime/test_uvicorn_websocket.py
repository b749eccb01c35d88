"""Streams on a real socket: complete and fragmented messages, several at once, and how a connection ends."""

import asyncio
import json
import os
import socket
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Opcode
from websockets.sync.client import ClientConnection, connect

from benchmarks.load.websocket import BINARY, frame_of
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.access import access_control
from serve_app.access.api_keys import ApiKey
from serve_app.access.connection_limit import ConnectionLimit
from serve_app.inference.stream_codec import RESPONSE, encode_request
from serve_app.routes import stream
from serve_app.routes.stream import ClosingTimes
from serve_app.runtime import uvicorn_websocket
from tests.support.clients.actions import BOARD, boards
from tests.support.leagues.served_leagues import promote
from tests.support.servers.replicas import QUICK
from tests.support.servers.streaming import Listening, listening
from tests.support.waiting import until

BODY = json.dumps({"observation": BOARD})
ONE = json.dumps({"observation": [1]})
DEADLINE = 60
"""Seconds for an answer. A slow machine that measures coverage takes many."""


@pytest.fixture(scope="module", params=["asyncio", "uvloop"])
def listener(storage: Storage, request: pytest.FixtureRequest) -> Iterator[Listening]:
    """A replica with either event loop, for tests that do not change its data."""
    with listening(storage, loop=request.param) as listener:
        yield listener


def open_stream(listener: Listening, model: str = "board", query: str = "", **options: Any) -> ClientConnection:
    return connect(listener.stream(model, query), compression=None, proxy=None, open_timeout=DEADLINE, **options)


def answer_to(stream: ClientConnection, message: str | bytes) -> dict[str, Any]:
    stream.send(message)
    return receive(stream)


def receive(stream: ClientConnection) -> dict[str, Any]:
    return json.loads(stream.recv(DEADLINE))


def close_of(stream: ClientConnection) -> tuple[int, str]:
    """The code and reason with which the server closes a stream."""
    with pytest.raises(ConnectionClosed) as caught:
        stream.recv(DEADLINE)
    assert caught.value.rcvd is not None
    return caught.value.rcvd.code, caught.value.rcvd.reason


def test_messages_are_answered_in_order(listener: Listening) -> None:
    requests = [{"observation": board} for board in boards(8)] * 20
    with open_stream(listener) as stream:
        one_by_one = [answer_to(stream, json.dumps(request)) for request in requests[:8]]
        assert len({answer["action"] for answer in one_by_one}) > 1
        for request in requests:  # without waiting: more than one turn answers
            stream.send(json.dumps(request))
        assert [receive(stream) for _ in requests] == one_by_one * 20
    with connect(listener.stream("board"), proxy=None) as stream:  # offers compression
        assert stream.response is not None
        assert "sec-websocket-extensions" not in stream.response.headers
        assert stream.response.headers["x-league-replica"] == "replica-1"


def test_a_stream_is_read_again_after_its_messages_had_to_wait(listener: Listening) -> None:
    message = encode_request([np.array([BOARD[name]], np.int8) for name in BOARD], 1)
    number = uvicorn_websocket.MAX_FRAMES_PER_TURN + 1
    with open_stream(listener) as stream:
        stream.send(message)
        expected = stream.recv(DEADLINE)
        # The last of them is answered in another turn, and at its end.
        stream.socket.sendall(frame_of(message, BINARY) * number)
        assert [stream.recv(DEADLINE) for _ in range(number)] == [expected] * number
        stream.send(message)
        assert stream.recv(DEADLINE) == expected


def test_messages_of_one_connection_share_one_state(listener: Listening) -> None:
    with open_stream(listener, "memory") as stream:
        for kind in range(40):
            stream.send(ONE if kind % 2 else encode_request([np.ones((1, 1), "<f4")], 1, reset=not kind))
        actions = []
        for kind in range(40):
            reply = stream.recv(DEADLINE)
            assert isinstance(reply, str) == bool(kind % 2)
            actions.append(
                json.loads(reply)["action"] if kind % 2 else int.from_bytes(reply[RESPONSE.size :], "little")
            )
        assert actions == [0, 0] + [1] * 38


KEY = "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="
UPGRADE = f"Connection: Upgrade\r\nUpgrade: websocket\r\n{KEY}"


def test_a_rejected_stream_has_an_error_response(listener: Listening) -> None:
    for query, origin, status, code in (
        ("?version=9", None, 404, "unknown_version"),
        ("?follow=0", None, 400, "invalid_reference"),
        ("", "https://evil.example", 403, "cross_site"),
    ):
        with pytest.raises(InvalidStatus) as caught, open_stream(listener, query=query, origin=origin):
            pass
        response = caught.value.response
        assert (response.status_code, json.loads(response.body or b"")["code"]) == (status, code)
    with open_stream(listener, origin=listener.url) as stream:
        assert answer_to(stream, BODY)["version"] == 1
    host, port = listener.url.removeprefix("http://").split(":")
    for no_handshake in (
        "Content-Length: 2\r\n\r\n{}",
        "Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        f"X: {'x' * 10_000}\r\n\r\n",
    ):
        with socket.create_connection((host, int(port)), timeout=DEADLINE) as client:
            head = f"GET /v1/policies/board/stream HTTP/1.1\r\nHost: {host}\r\n{UPGRADE}\r\n"
            client.sendall((head + no_handshake).encode())
            assert client.makefile("rb").read().startswith(b"HTTP/1.1 400 ")


def test_a_fragmented_message_is_one_message(listener: Listening) -> None:
    parts = [BODY[at : at + 100] for at in range(0, len(BODY), 100)]
    with open_stream(listener) as stream:
        expected = answer_to(stream, BODY)
        stream.send(parts)
        stream.send(BODY)
        assert [receive(stream), receive(stream)] == [expected, expected]
        binary = encode_request([np.array([BOARD[name]], np.int8) for name in BOARD], 1)
        stream.send(binary)
        stream.send([binary[:1], b"", binary[1:50], binary[50:]])
        assert stream.recv(DEADLINE) == stream.recv(DEADLINE)


def test_pings_are_answered_between_fragments(listener: Listening) -> None:
    with open_stream(listener) as stream:
        assert stream.ping().wait(DEADLINE)

        def parts() -> Iterator[str]:
            for at in range(0, len(BODY), 100):
                stream.protocol.send_ping(b"between")
                yield BODY[at : at + 100]

        stream.send(parts())
        assert receive(stream)["version"] == 1
        assert stream.ping().wait(DEADLINE)
        assert answer_to(stream, BODY)["version"] == 1


class RawClient:
    """A client that sends arbitrary bytes at any time."""

    def __init__(self, listener: Listening, model: str = "board", token: str = "none") -> None:
        host, port = listener.url.removeprefix("http://").split(":")
        self.socket = socket.socket()
        for buffer in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            # Small ones are full after some messages, megabytes after tens of thousands.
            self.socket.setsockopt(socket.SOL_SOCKET, buffer, 16384)
        self.socket.settimeout(DEADLINE)
        self.socket.connect((host, int(port)))
        self.socket.sendall(
            f"GET /v1/policies/{model}/stream HTTP/1.1\r\nHost: {host}\r\n{UPGRADE}\r\n"
            f"X-Api-Key: {token}\r\n\r\n".encode()
        )
        self.file = self.socket.makefile("rb")
        assert b" 101 " in self.file.readline()
        while self.file.readline() != b"\r\n":
            pass

    def frame(self) -> tuple[int, bytes]:
        """The next frame: first byte and payload."""
        first, length = self.file.read(2)
        if length >= 126:
            length = int.from_bytes(self.file.read(2 if length == 126 else 8), "big")
        return first, self.file.read(length)

    def answer(self) -> tuple[int, bytes]:
        """The next frame that is not a ping, which the server sends in intervals."""
        while (received := self.frame())[0] == 0x89:
            pass
        return received

    def flood(self, message: bytes) -> int:
        """Send a message repeatedly without reading, until no more is accepted; returns the number of bytes."""
        sent = 0
        self.socket.settimeout(0.15)
        with suppress(TimeoutError):
            while True:
                assert sent < 200 * 2**20, "the server does not stop reading"
                sent += self.socket.send(message * 100)
        return sent

    def end(self) -> int:
        """The code with which the server closes; asserts that nothing follows."""
        first, payload = self.frame()
        assert first == 0x88
        self.socket.sendall(frame(payload[:2], 0x88))
        assert self.file.read() == b""
        self.socket.close()
        return int.from_bytes(payload[:2], "big")


def shrink_send_buffers(listener: Listening) -> None:
    """Of connections that the server accepts from now on: they are full after some answers."""
    with socket.socket(fileno=os.dup(listener.uvicorn.servers[0].sockets[0].fileno())) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16384)


def frame(payload: bytes, first: int = 0x81, mask: bytes = b"\1\2\3\4") -> bytes:
    """A masked frame; by default a complete text message."""
    size = len(payload)
    if size < 126:
        length = bytes([0x80 | size])
    elif size < 2**16:
        length = b"\xfe" + struct.pack(">H", size)
    else:
        length = b"\xff" + struct.pack(">Q", size)
    return bytes([first]) + length + mask + bytes(byte ^ mask[at % 4] for at, byte in enumerate(payload))


PING = frame(b"", 0x89)
PONG = (0x8A, b"")


def nothing_follows(raw: RawClient, listener: Listening, token: str) -> bool:
    """Whether a client gets nothing while the server answers another one several times."""
    with open_stream(listener, additional_headers={"x-api-key": token}) as stream:
        for _ in range(5):
            assert answer_to(stream, BODY)["version"] == 1
    raw.socket.setblocking(False)
    try:
        return raw.file.read(1) is None
    finally:
        raw.socket.settimeout(DEADLINE)


def test_frames_wait_for_the_rate_of_the_key(registry: Registry, subtests: pytest.Subtests) -> None:
    """A client whose messages are refused, or that sends other frames, is not read for a while."""
    _, other = registry.keys.create("other", ["act"])
    flood = {
        "pings": PING * 1000,
        "pongs": frame(b"", 0x8A) * 1000 + PING,
        "fragments": frame(b"{", 0x01) + PING,
        "unmasked": b"\x81\x02{}",
        "refused": frame(b"{}") * 500,
    }
    tokens = {name: registry.keys.create(name, ["act"], rate=0.001)[1] for name in flood}
    with listening(registry.storage) as listener:
        for name, sent in flood.items():
            with subtests.test(name):
                raw = RawClient(listener, token=tokens[name])  # the handshake is the request that the rate permits
                raw.socket.sendall(sent)
                assert name != "refused" or b"rate_limited" in raw.frame()[1]
                assert nothing_follows(raw, listener, other)
                raw.socket.close()


def test_answers_to_pings_of_the_server_are_free(registry: Registry) -> None:
    _, slow = registry.keys.create("slow", ["act"], rate=0.001)
    with listening(registry.storage, ws_ping_interval=0.05, ws_ping_timeout=DEADLINE) as listener:
        raw = RawClient(listener, token=slow)
        for _ in range(3):  # the next ping follows only an answer
            first, payload = raw.frame()
            assert first == 0x89
            raw.socket.sendall(frame(payload, 0x8A))
        raw.socket.sendall(frame(b"\x03\xe8", 0x88))
        assert raw.answer() == (0x88, b"\x03\xe8"), "a client may always close"


def test_frames_of_all_connections_share_the_turn(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many pings wait, a turn of the event loop handles few of them."""
    per_turn: Counter[int] = Counter()
    turn = 0
    with listening(storage) as listener:
        access, admit = listener.server.access, listener.server.access.admit_frame

        def count(key: ApiKey | None) -> float:
            nonlocal turn
            if not per_turn:
                count_turn()
            per_turn[turn] += 1
            return admit(key)

        def count_turn() -> None:
            nonlocal turn
            turn += 1
            asyncio.get_running_loop().call_soon(count_turn)

        monkeypatch.setattr(access, "admit_frame", count)
        clients = [RawClient(listener) for _ in range(3)]
        for raw in clients:
            raw.socket.sendall(PING * 500)
        for raw in clients:
            assert [raw.answer() for _ in range(500)] == [PONG] * 500
            raw.socket.close()
        assert max(per_turn.values()) <= uvicorn_websocket.MAX_FRAMES_PER_TURN + len(clients)


def test_frames_without_a_key_share_a_rate(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access_control, "FRAMES", 10)
    with listening(storage) as listener:
        raw = RawClient(listener)
        raw.socket.sendall(PING * 1000)
        assert raw.answer() == PONG
        with open_stream(listener) as stream:
            assert answer_to(stream, BODY)["version"] == 1
        raw.socket.setblocking(False)
        assert len(raw.file.read(2000) or b"") < 1000
        raw.socket.close()


def test_incomplete_messages_have_limited_memory(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stream that exceeds the limit is closed, unless it holds little; others are not affected."""
    monkeypatch.setattr(uvicorn_websocket, "CLOSE_TIMEOUT", 0.1)  # a message is still incomplete
    settings = QUICK.model_copy(update={"max_body": 2**20, "max_batch": 1024, "max_incomplete": 300_000})
    half = frame(b" " * 200_000, 0x01)
    with listening(storage, settings) as listener:
        first, small, second = (RawClient(listener) for _ in range(3))
        for raw, part in ((first, half), (small, frame(BODY.encode(), 0x01))):
            raw.socket.sendall(part + PING)
            assert raw.frame() == PONG
        second.socket.sendall(half)
        assert second.end() == 1013
        first.socket.sendall(frame(b"", 0x80))
        assert b"malformed_body" in first.frame()[1]
        small.socket.sendall(frame(b"", 0x80))
        assert b"action" in small.frame()[1]
        again = RawClient(listener)
        again.socket.sendall(half + frame(b"", 0x80))
        assert b"malformed_body" in again.frame()[1], "what was held is released"
        for raw in (first, small, again):
            raw.socket.close()


INVALID_MESSAGE = frame(b'{"wrong": 1}' + b" " * 50)


def test_frames_can_arrive_byte_by_byte_or_all_at_once(listener: Listening) -> None:
    raw = RawClient(listener)
    for byte in frame(BODY.encode()):
        raw.socket.sendall(bytes([byte]))
    expected = raw.frame()
    assert expected[0] == 0x81
    message = frame(BODY.encode(), mask=b"\x80\0\xff\7")
    raw.socket.sendall(message * 50 + message[:-1])
    assert [raw.frame() for _ in range(50)] == [expected] * 50
    raw.socket.sendall(message[-1:] + frame(b"hello", 0x89))
    assert [raw.frame(), raw.frame()] == [expected, (0x8A, b"hello")]
    raw.socket.sendall(frame(b"\x03\xe8", 0x88))
    assert raw.frame() == (0x88, b"\x03\xe8")
    assert raw.file.read() == b"", "the connection is closed"


INVALID_FRAMES = (
    (b"\x81\x02{}", 1002),  # not masked
    (frame(b"{}", 0x83), 1002),  # invalid opcode
    (frame(b"{}", 0xC1), 1002),  # extension bit
    (frame(b"{}", 0x80), 1002),  # continuation without a start
    (frame(b"{", 0x01) + frame(b"{}"), 1002),  # second message within a first
    (frame(b"x" * 126, 0x89), 1002),  # ping that is too long
    (frame(b"\xff{}"), 1007),
    (frame(b"{", 0x01) + frame(b"\xff}", 0x80), 1007),
    (b"\x81\xff" + struct.pack(">Q", 2**40) + b"\1\2\3\4", 1009),
    (b"\x82\xff" + struct.pack(">Q", 2**63) + b"\1\2\3\4", 1009),
    (frame(b" " * (64 * 1024 + 1)), 1009),
    (frame(b" " * 2**15, 0x01) + frame(b" " * 2**15, 0x00) + frame(b" ", 0x80), 1009),
    (frame(b"{", 0x01) + frame(b"", 0x00) * 1024 + frame(b"", 0x80), 1009),  # too many fragments
)


def test_an_invalid_frame_ends_the_stream(listener: Listening, subtests: pytest.Subtests) -> None:
    for sent, code in INVALID_FRAMES:
        with subtests.test(sent=sent[:20], code=code):
            raw = RawClient(listener)
            raw.socket.sendall(frame(BODY.encode()) + sent)
            assert b'"version":1' in raw.frame()[1], "earlier messages are answered"
            assert raw.end() == code


def test_all_encodings_of_the_length(listener: Listening) -> None:
    with open_stream(listener) as stream, open_stream(listener, "vector") as vector:
        for size in (125, 126, 2**16 - 1, 2**16):
            assert answer_to(stream, (BODY if size > len(BODY) else "{}").ljust(size))
        many = json.dumps({"observations": [[0.5, 1]] * 8, "probabilities": True})
        assert len(json.dumps(answer_to(vector, many))) > 126


def test_the_server_stops_reading_from_a_client_that_does_not_read(listener: Listening) -> None:
    """Other clients are answered in the meantime, and this one as soon as it reads."""
    shrink_send_buffers(listener)
    raw = RawClient(listener)
    sent = raw.flood(INVALID_MESSAGE)
    with open_stream(listener) as stream:
        assert answer_to(stream, BODY)["version"] == 1
    raw.socket.settimeout(DEADLINE)
    rejected = raw.answer()
    for _ in range(sent // len(INVALID_MESSAGE) - 1):
        assert raw.answer() == rejected
    raw.socket.close()


def test_a_slow_graph_is_awaited(storage: Storage) -> None:
    settings = QUICK.model_copy(update={"inline": 1e-9})
    with listening(storage, settings) as listener, open_stream(listener, "memory") as stream:
        for _ in range(40):
            stream.send(ONE)
        assert [receive(stream)["action"] for _ in range(40)] == [0, 0] + [1] * 38
        assert stream.ping().wait(DEADLINE)


def test_a_revoked_key_ends_an_idle_stream(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason of a close frame is limited to 123 bytes, and the name of a key to 100."""
    monkeypatch.setattr(stream, "KEY_CHECK_INTERVAL", 0.05)
    tokens = {name: registry.keys.create(name, ["act"])[1] for name in ("bot", "b" * 100)}
    with listening(registry.storage) as listener:
        for name, token in tokens.items():
            with open_stream(listener, additional_headers={"x-api-key": token}) as connection:
                registry.keys.revoke(name)
                code, reason = close_of(connection)
                assert (code, f"{name} was" in reason) == (1008, True)
            until(lambda: listener.server.stream.connections.open == 0)


def test_a_draining_server_sends_a_last_message(registry: Registry) -> None:
    with listening(registry.storage) as listener, listening(registry.storage) as other:
        with (
            open_stream(listener) as plain,
            open_stream(listener, "memory") as recurrent,
            open_stream(listener, "memory") as batch,
        ):
            answer_to(plain, BODY)
            answer_to(batch, json.dumps({"observations": [[1], [2]]}))
            assert [answer_to(recurrent, ONE)["action"] for _ in range(2)] == [0, 0]
            promote(registry, "board", 2)
            listener.drain()
            last_message = receive(recurrent)
            assert last_message.keys() == {"closing", "state", "model", "version", "sha256"}
            assert (last_message["closing"], last_message["model"], last_message["version"]) == (True, "memory", 1)
            assert close_of(recurrent) == (1012, "the replica is shutting down: reconnect")
            assert [type(token) for token in receive(batch)["state"]] == [str, str]
            assert close_of(plain)[0] == close_of(batch)[0] == 1012
        with open_stream(other, "memory", f"?version={last_message['version']}") as again:
            assert answer_to(again, json.dumps({"observation": [1], "state": last_message["state"]}))["action"] == 1


def test_a_client_that_neither_reads_nor_closes_does_not_block_stopping(storage: Storage) -> None:
    with listening(storage) as listener:
        shrink_send_buffers(listener)
        raw = RawClient(listener)
        raw.flood(INVALID_MESSAGE)
    raw.socket.close()


def test_a_client_that_does_not_respond_is_disconnected(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uvicorn_websocket, "CLOSE_TIMEOUT", 0.2)
    with listening(storage, ws_ping_interval=0.1, ws_ping_timeout=0.1) as listener:
        raw = RawClient(listener)
        assert raw.frame()[0] == 0x80 | Opcode.PING
        first, payload = raw.frame()
        assert (first, payload[:2]) == (0x88, (1011).to_bytes(2, "big"))
        assert raw.file.read() == b""
        until(lambda: listener.server.stream.connections.open == 0)


def test_broken_connections_are_removed(listener: Listening, monkeypatch: pytest.MonkeyPatch) -> None:
    connections = ConnectionLimit("streams", 3, 3)  # without those of other tests, which may not have ended yet
    monkeypatch.setattr(listener.server.stream, "connections", connections)
    for sent in (b"", frame(BODY.encode()), frame(BODY.encode())[:50]):
        raw = RawClient(listener)
        raw.socket.sendall(sent)
        # Closes with a reset.
        raw.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        raw.file.close()
        raw.socket.close()
    until(lambda: connections.open == 0)


def closing(connection: ClientConnection) -> tuple[int, dict[str, Any]]:
    """The close code of a stream, and the message before it."""
    last: dict[str, Any] = {}
    try:
        while True:
            last = receive(connection)
    except ConnectionClosed as end:
        return end.rcvd.code if end.rcvd else 1006, last


@pytest.mark.parametrize("change", ["added", "removed", "drained"])
def test_open_streams_reconnect_when_the_number_of_replicas_has_changed(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    monkeypatch.setattr(stream, "AFTER_CHANGE", ClosingTimes(0.0, 0.0))
    if change != "added":
        registry.replicas.register("replica-2", {})
    with (
        listening(registry.storage) as listener,
        open_stream(listener, "memory") as one,
        open_stream(listener, "memory") as other,
    ):
        for connection in (one, one, other, other):
            assert answer_to(connection, ONE)["action"] == 0  # the third one would be 1
        if change == "removed":
            registry.replicas.remove("replica-2")
        else:
            registry.replicas.register("replica-2", {}, is_draining=change == "drained")
        for connection in (one, other):
            code, last = closing(connection)
            assert (code, last["closing"]) == (1012, True)
        with open_stream(listener, "memory") as again:
            assert answer_to(again, json.dumps({"observation": [1], "state": last["state"]}))["action"] == 1


def test_streams_stay_open_when_a_drained_replica_ends(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """They reconnected when it began to drain."""
    monkeypatch.setattr(stream, "AFTER_CHANGE", ClosingTimes(0.0, 0.0))
    registry.replicas.register("replica-2", {}, is_draining=True)
    with listening(registry.storage) as listener, open_stream(listener, "memory") as connection:
        assert [answer_to(connection, ONE)["action"] for _ in range(2)] == [0, 0]
        registry.replicas.remove("replica-2")
        for _ in range(2):
            last = registry.replicas.registered()[0].seen_at
            until(lambda last=last: registry.replicas.registered()[0].seen_at > last)
        assert listener.server.stream._closings == {}
        assert answer_to(connection, ONE)["action"] == 1


def test_streams_of_a_replica_that_stops_are_closed_earlier(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "AFTER_CHANGE", ClosingTimes(300.0, 400.0))
    monkeypatch.setattr(stream, "WHILE_DRAINING", ClosingTimes(0.0, 0.0))
    monkeypatch.setattr(stream, "KEY_CHECK_INTERVAL", 0.05)
    with listening(registry.storage) as listener, open_stream(listener, "memory") as connection:
        registry.replicas.register("replica-2", {})
        answer_to(connection, ONE)
        monkeypatch.setattr(listener.server.stream, "_is_draining", lambda: True)
        assert closing(connection)[0] == 1012
