"""Responses are sent as one write, completely and in order, and streams are not delayed."""

import asyncio
import socket
import threading
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.types import Receive, Scope, Send

from serve_app.runtime.joined_writes import MAX_HELD, JoinedWrites
from tests.support.servers.http_protocol import serving

REQUEST = b"GET / HTTP/1.1\r\nhost: here\r\n\r\n"
OPERATIONS = st.lists(st.binary(max_size=40) | st.just("flush") | st.just("turn"))


class Recorder(asyncio.Transport):
    """A transport that records its writes."""

    def __init__(self) -> None:
        super().__init__()
        self.writes: list[bytes] = []
        self.closed = False

    def write(self, data: bytes) -> None:  # type: ignore[override]
        assert not self.closed
        self.writes.append(data)

    def close(self) -> None:
        self.closed = True

    def is_closing(self) -> bool:
        return self.closed


@given(operations=OPERATIONS)
def test_everything_is_sent_once_and_in_order(operations: list[bytes | str]) -> None:
    recorder, turn = Recorder(), list[Callable[[], None]]()
    joined = JoinedWrites(recorder, turn.append)
    written: list[bytes] = []
    for operation in operations:
        if operation == "flush":
            joined.flush()
        elif operation == "turn":
            while turn:
                turn.pop()()
            assert b"".join(recorder.writes) == b"".join(written)
        else:
            assert isinstance(operation, bytes)
            written.append(operation)
            joined.write(operation)
    joined.close()
    assert b"".join(recorder.writes) == b"".join(written)
    assert recorder.closed


def test_a_head_and_its_body_are_one_write() -> None:
    recorder = Recorder()
    joined = JoinedWrites(recorder, lambda _: None)
    joined.write(b"head")
    joined.write(b"body")
    assert recorder.writes == []
    joined.flush()
    assert recorder.writes == [b"headbody"]


def test_no_more_than_the_limit_is_held() -> None:
    recorder = Recorder()
    joined = JoinedWrites(recorder, lambda _: None)
    joined.write(b"head")
    joined.write(bytes(MAX_HELD))
    assert sum(map(len, recorder.writes)) == 4 + MAX_HELD


def test_a_closed_connection_drops_what_is_held() -> None:
    recorder = Recorder()
    joined = JoinedWrites(recorder, lambda _: None)
    joined.write(b"head")
    recorder.close()
    joined.flush()
    assert recorder.writes == []


@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_a_stream_sends_its_head_before_it_has_a_body(loop: str) -> None:
    go_on = threading.Event()

    async def application(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"4")]})
        await asyncio.to_thread(go_on.wait, 20)
        await send({"type": "http.response.body", "body": b"body"})

    with serving(application, loop) as address, socket.create_connection(address, timeout=20) as client:
        try:
            client.sendall(REQUEST)
            head = client.recv(4096)
            assert head.startswith(b"HTTP/1.1 200")
            assert head.endswith(b"\r\n\r\n")
            go_on.set()
            assert client.recv(4096) == b"body"
        finally:
            go_on.set()
