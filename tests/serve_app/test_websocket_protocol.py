"""Streams over a real socket: messages that come whole, in parts and all at once, and how a connection ends."""

import json
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Opcode
from websockets.sync.client import ClientConnection, connect

from league.registry.registry import Registry
from league.settings import Storage
from serve_app import websocket_protocol
from serve_app.stream_framing import REPLY, request
from tests.serve_app.conftest import QUICK
from tests.serve_app.leagues import promote
from tests.serve_app.streaming import Listening, listening
from tests.serve_app.test_action import BOARD, boards
from tests.serve_app.test_alias_watcher import until

BODY = json.dumps({"observation": BOARD})
ONE = json.dumps({"observation": [1]})


@pytest.fixture(scope="module", params=["asyncio", "uvloop"])
def listener(storage: Storage, request: pytest.FixtureRequest) -> Iterator[Listening]:
    """A replica on either event loop, for tests that change nothing."""
    with listening(storage, loop=request.param) as listener:
        yield listener


def opened(listener: Listening, model: str = "board", query: str = "", **options: Any) -> ClientConnection:
    return connect(listener.stream(model, query), compression=None, proxy=None, **options)


def said(stream: ClientConnection, message: str | bytes) -> dict[str, Any]:
    stream.send(message)
    return heard(stream)


def heard(stream: ClientConnection) -> dict[str, Any]:
    return json.loads(stream.recv(20))


def closed(stream: ClientConnection) -> tuple[int, str]:
    """How the server closes a stream."""
    with pytest.raises(ConnectionClosed) as caught:
        stream.recv(20)
    assert caught.value.rcvd is not None
    return caught.value.rcvd.code, caught.value.rcvd.reason


def test_messages_are_answered_in_order(listener: Listening) -> None:
    asked = [{"observation": board} for board in boards(8)] * 20
    with opened(listener) as stream:
        one_by_one = [said(stream, json.dumps(ask)) for ask in asked[:8]]
        assert len({answer["action"] for answer in one_by_one}) > 1
        for ask in asked:  # without waiting: more than are answered in one turn
            stream.send(json.dumps(ask))
        assert [heard(stream) for _ in asked] == one_by_one * 20


def test_one_connection_s_messages_keep_one_state(listener: Listening) -> None:
    with opened(listener, "memory") as stream:
        for kind in range(40):
            stream.send(ONE if kind % 2 else request([np.ones((1, 1), "<f4")], 1, reset=not kind))
        actions = []
        for kind in range(40):
            reply = stream.recv(20)
            assert isinstance(reply, str) == bool(kind % 2)
            actions.append(json.loads(reply)["action"] if kind % 2 else int.from_bytes(reply[REPLY.size :], "little"))
        assert actions == [0, 0] + [1] * 38


def test_nothing_is_compressed(listener: Listening) -> None:
    with connect(listener.stream("board"), proxy=None) as stream:  # which offers to
        assert stream.response is not None
        assert "sec-websocket-extensions" not in stream.response.headers
        assert stream.response.headers["x-league-replica"] == "replica-1"
        assert said(stream, BODY)["version"] == 1


@pytest.mark.parametrize(("query", "status", "code"), [("?version=9", 404, "unknown_version"), ("?follow=0", 400, "")])
def test_a_stream_that_is_refused_is_told_why(listener: Listening, query: str, status: int, code: str) -> None:
    with pytest.raises(InvalidStatus) as caught, opened(listener, query=query):
        pass
    refusal = caught.value.response
    assert refusal.status_code == status
    assert json.loads(refusal.body or b"")["code"] in (code, "invalid_reference")


def test_a_message_in_fragments_is_one_message(listener: Listening) -> None:
    parts = [BODY[at : at + 100] for at in range(0, len(BODY), 100)]
    with opened(listener) as stream:
        whole = said(stream, BODY)
        stream.send(parts)
        stream.send(BODY)
        assert [heard(stream), heard(stream)] == [whole, whole]
        binary = request([np.array([BOARD[name]], np.int8) for name in BOARD], 1)
        stream.send(binary)
        stream.send([binary[:1], b"", binary[1:50], binary[50:]])
        assert stream.recv(20) == stream.recv(20)


def test_pings_are_answered_between_fragments_too(listener: Listening) -> None:
    with opened(listener) as stream:
        assert stream.ping().wait(20)

        def parts() -> Iterator[str]:
            for at in range(0, len(BODY), 100):
                stream.protocol.send_ping(b"between")
                yield BODY[at : at + 100]

        stream.send(parts())
        assert heard(stream)["version"] == 1
        assert stream.ping().wait(20)
        assert said(stream, BODY)["version"] == 1


class Raw:
    """A client that sends what bytes it likes, and when."""

    def __init__(self, listener: Listening, model: str = "board") -> None:
        host, port = listener.url.removeprefix("http://").split(":")
        self.socket = socket.create_connection((host, int(port)), 20)
        self.socket.sendall(
            f"GET /v1/policies/{model}/stream HTTP/1.1\r\nHost: {host}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
        )
        self.file = self.socket.makefile("rb")
        assert b" 101 " in self.file.readline()
        while self.file.readline() != b"\r\n":
            pass

    def frame(self) -> tuple[int, bytes]:
        """The next one: first byte and payload."""
        first, length = self.file.read(2)
        if length >= 126:
            length = int.from_bytes(self.file.read(2 if length == 126 else 8), "big")
        return first, self.file.read(length)

    def flood(self, message: bytes) -> int:
        """Send a message over and over, and read nothing, until nothing more is taken; returns how many bytes were."""
        sent = 0
        self.socket.settimeout(1)
        with suppress(TimeoutError):
            while True:
                assert sent < 200 * 2**20, "all is taken"
                sent += self.socket.send(message * 100)
        return sent

    def end(self) -> int:
        """The code by which the server closes, after which nothing comes but the end."""
        first, payload = self.frame()
        assert first == 0x88
        self.socket.sendall(frame(payload[:2], 0x88))
        assert self.file.read() == b""
        self.socket.close()
        return int.from_bytes(payload[:2], "big")


def frame(payload: bytes, first: int = 0x81, mask: bytes = b"\1\2\3\4") -> bytes:
    """A masked frame; by default a text in one."""
    size = len(payload)
    if size < 126:
        length = bytes([0x80 | size])
    elif size < 2**16:
        length = b"\xfe" + struct.pack(">H", size)
    else:
        length = b"\xff" + struct.pack(">Q", size)
    return bytes([first]) + length + mask + bytes(byte ^ mask[at % 4] for at, byte in enumerate(payload))


WRONG = frame(b'{"wrong": 1}' + b" " * 50)


def test_frames_may_come_byte_by_byte_and_all_at_once(listener: Listening) -> None:
    raw = Raw(listener)
    for byte in frame(BODY.encode()):
        raw.socket.sendall(bytes([byte]))
    whole = raw.frame()
    assert whole[0] == 0x81
    message = frame(BODY.encode(), mask=b"\x80\0\xff\7")
    raw.socket.sendall(message * 50 + message[:-1])
    assert [raw.frame() for _ in range(50)] == [whole] * 50
    raw.socket.sendall(message[-1:] + frame(b"hello", 0x89))
    assert [raw.frame(), raw.frame()] == [whole, (0x8A, b"hello")]
    raw.socket.sendall(frame(b"\x03\xe8", 0x88))
    assert raw.frame() == (0x88, b"\x03\xe8")
    assert raw.file.read() == b"", "and it hangs up"


@pytest.mark.parametrize(
    ("sent", "code"),
    [
        (b"\x81\x02{}", 1002),  # not masked
        (frame(b"{}", 0x83), 1002),  # an opcode that is none
        (frame(b"{}", 0xC1), 1002),  # a bit of an extension
        (frame(b"{}", 0x80), 1002),  # goes on with nothing
        (frame(b"{", 0x01) + frame(b"{}"), 1002),  # a second message within a first
        (frame(b"x" * 126, 0x89), 1002),  # a ping that is too long
        (frame(b"\xff{}"), 1007),
        (frame(b"{", 0x01) + frame(b"\xff}", 0x80), 1007),
        (b"\x81\xff" + struct.pack(">Q", 2**40) + b"\1\2\3\4", 1009),
        (b"\x82\xff" + struct.pack(">Q", 2**63) + b"\1\2\3\4", 1009),
        (frame(b" " * (64 * 1024 + 1)), 1009),
        (frame(b" " * 2**15, 0x01) + frame(b" " * 2**15, 0x00) + frame(b" ", 0x80), 1009),
    ],
)
def test_what_is_no_message_ends_the_stream(listener: Listening, sent: bytes, code: int) -> None:
    raw = Raw(listener)
    raw.socket.sendall(frame(BODY.encode()) + sent)
    assert b'"version":1' in raw.frame()[1], "what came before is answered"
    assert raw.end() == code


@pytest.mark.parametrize("size", [125, 126, 2**16 - 1, 2**16])
def test_lengths_of_every_kind(listener: Listening, size: int) -> None:
    with opened(listener) as stream:
        assert said(stream, BODY + " " * (size - len(BODY)) if size > len(BODY) else "{}".ljust(size))
    with opened(listener, "vector") as stream:
        many = json.dumps({"observations": [[0.5, 1]] * 8, "probabilities": True})
        assert len(json.dumps(said(stream, many))) > 126


def test_a_client_that_does_not_read_is_not_read_from(listener: Listening) -> None:
    """What it sends stays with it; others are answered meanwhile, and it is once it reads."""
    raw = Raw(listener)
    sent = raw.flood(WRONG)
    with opened(listener) as stream:
        assert said(stream, BODY)["version"] == 1
    raw.socket.settimeout(20)
    refused = raw.frame()
    for _ in range(sent // len(WRONG) - 1):
        assert raw.frame() == refused
    raw.socket.close()


def test_a_graph_that_takes_long_is_waited_for(storage: Storage) -> None:
    settings = QUICK.model_copy(update={"inline": 1e-9})
    with listening(storage, settings) as listener, opened(listener, "memory") as stream:
        for _ in range(40):
            stream.send(ONE)
        assert [heard(stream)["action"] for _ in range(40)] == [0, 0] + [1] * 38
        assert stream.ping().wait(20)


def test_a_revoked_key_ends_the_stream(registry: Registry) -> None:
    _, token = registry.create_key("bot", ["act"])
    with (
        listening(registry.storage) as listener,
        opened(listener, additional_headers={"x-api-key": token}) as stream,
    ):
        assert said(stream, BODY)["version"] == 1
        registry.revoke_key("bot")
        with pytest.raises(ConnectionClosed) as caught:
            until(lambda: said(stream, BODY) and False)
        assert caught.value.rcvd is not None
        assert (caught.value.rcvd.code, "bot was revoked" in caught.value.rcvd.reason) == (1008, True)
        until(lambda: listener.server.stream.open == 0)


def test_a_server_that_drains_says_goodbye(registry: Registry) -> None:
    with listening(registry.storage) as listener, listening(registry.storage) as other:
        with opened(listener) as plain, opened(listener, "memory") as recurrent:
            said(plain, BODY)
            assert [said(recurrent, ONE)["action"] for _ in range(2)] == [0, 0]
            promote(registry, "board", 2)
            listener.drain()
            farewell = heard(recurrent)
            assert farewell.keys() == {"closing", "state", "model", "version", "sha256"}
            assert (farewell["closing"], farewell["model"], farewell["version"]) == (True, "memory", 1)
            assert closed(recurrent) == (1012, "the replica drains: connect again")
            assert closed(plain)[0] == 1012
        with opened(other, "memory", f"?version={farewell['version']}") as again:
            assert said(again, json.dumps({"observation": [1], "state": farewell["state"]}))["action"] == 1


def test_a_farewell_to_a_batch_has_the_state_of_each(storage: Storage) -> None:
    with listening(storage) as listener, opened(listener, "memory") as stream:
        said(stream, json.dumps({"observations": [[1], [2]]}))
        listener.drain()
        assert [type(token) for token in heard(stream)["state"]] == [str, str]
        assert closed(stream)[0] == 1012


def test_a_client_that_neither_reads_nor_leaves_holds_up_no_stop(
    storage: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(websocket_protocol, "CLOSE_TIMEOUT", 0.2)
    with listening(storage) as listener:
        raw = Raw(listener)
        raw.flood(WRONG)
    raw.socket.close()


def test_a_client_that_does_not_answer_is_hung_up_on(storage: Storage) -> None:
    with listening(storage, ws_ping_interval=0.1, ws_ping_timeout=0.1) as listener:
        raw = Raw(listener)
        assert raw.frame()[0] == 0x80 | Opcode.PING
        first, payload = raw.frame()
        assert (first, payload[:2]) == (0x88, (1011).to_bytes(2, "big"))
        assert raw.file.read() == b""
        until(lambda: listener.server.stream.open == 0)


def test_connections_that_break_are_forgotten(listener: Listening) -> None:
    for sent in (b"", frame(BODY.encode()), frame(BODY.encode())[:50]):
        raw = Raw(listener)
        raw.socket.sendall(sent)
        # Hangs up with a reset.
        raw.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        raw.file.close()
        raw.socket.close()
    until(lambda: listener.server.stream.open == 0)
