"""Concurrent clients are accepted at once and in order, and idle ones have limits."""

import asyncio
import gc
import resource
import socket
import struct
import threading
import weakref
from collections import Counter
from contextlib import suppress
from weakref import WeakKeyDictionary

import httpx
import pytest
from starlette.responses import Response
from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.httptools_impl import RequestResponseCycle
from uvicorn.server import ServerState

from serve_app.runtime import uvicorn_http
from serve_app.runtime.uvicorn_http import AcceptQueue, HttpProtocol
from tests.support.servers.http_protocol import serving
from tests.support.waiting import until

CLIENTS = 40
DEADLINE = 60
"""Seconds for an answer. A busy machine takes many."""
REQUEST = b"GET / HTTP/1.1\r\nhost: here\r\nconnection: close\r\n\r\n"


async def no_content(_: Scope, __: Receive, send: Send) -> None:
    """An application that answers each request at once."""
    await send({"type": "http.response.start", "status": 204, "headers": []})
    await send({"type": "http.response.body"})


class TurnCounting:
    """One that records the turn of the event loop in which each request starts, and keeps the loop busy."""

    def __init__(self) -> None:
        self.turn = 0
        self.request_turns: list[int] = []
        self.loop: asyncio.AbstractEventLoop | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self.loop is None:
            self.loop = asyncio.get_running_loop()
            self._count()
        self.request_turns.append(self.turn)
        await no_content(scope, receive, send)

    def _count(self) -> None:
        assert self.loop is not None
        self.turn += 1
        self.loop.call_soon(self._count)


def receive_all(connection: socket.socket) -> bool:
    """The complete response, until the server closes the connection."""
    with connection:
        connection.settimeout(DEADLINE)
        reply = b"".join(iter(lambda: connection.recv(4096), b""))
    return reply.startswith(b"HTTP/1.1 204")


@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_clients_that_arrived_while_the_loop_was_busy_start_together(loop: str) -> None:
    application, is_busy, go_on = TurnCounting(), threading.Event(), threading.Event()

    def wait() -> None:
        is_busy.set()
        go_on.wait(DEADLINE)

    with serving(application, loop) as address:
        first = socket.create_connection(address)
        first.sendall(REQUEST)
        assert receive_all(first)
        assert application.loop is not None
        application.loop.call_soon_threadsafe(wait)
        is_busy.wait()
        clients = [socket.create_connection(address) for _ in range(CLIENTS)]
        for client in clients:
            client.sendall(REQUEST)
        go_on.set()
        assert all(map(receive_all, clients))
    assert len(application.request_turns) == CLIENTS + 1
    assert application.request_turns[-1] - application.request_turns[1] < CLIENTS / 4, (
        "too many turns between the first and the last"
    )


def test_a_stopping_server_accepts_no_connections() -> None:
    with serving(no_content, "uvloop") as address:
        client = socket.create_connection(address)
        client.sendall(REQUEST)
        assert receive_all(client)
        assert listens(address)
    # Another process may listen on the port by now.
    assert not listens(address)


def listens(address: tuple[str, int]) -> bool:
    """Whether this process listens on a port."""
    return AcceptQueue(address[1])._listener is not None


def answered(connection: socket.socket) -> bytes:
    """The head of a response."""
    connection.settimeout(DEADLINE)
    reply = b""
    while b"\r\n\r\n" not in reply and (data := connection.recv(4096)):
        reply += data
    return reply


KEEP_ALIVE = b"GET / HTTP/1.1\r\nhost: here\r\n\r\n"


def test_a_connection_stays_open_unless_many_are(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(no_content, "uvloop") as address:
        with socket.create_connection(address) as client:
            for _ in range(2):
                client.sendall(KEEP_ALIVE)
                assert b"connection: close" not in answered(client)
        monkeypatch.setattr(uvicorn_http, "CROWDED", 0)
        with socket.create_connection(address) as client:
            client.sendall(KEEP_ALIVE)
            assert b"connection: close" in answered(client)
            assert client.recv(1) == b""


def test_a_connection_without_a_request_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uvicorn_http, "FIRST_REQUEST", 0.05)
    with serving(no_content, "uvloop") as address:
        for sent in (b"", KEEP_ALIVE[:-2]):
            # The connection may be closed before this process has sent anything.
            with socket.create_connection(address) as client, suppress(ConnectionError):
                client.sendall(sent)
                client.settimeout(DEADLINE)
                assert client.recv(1) == b""


@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_a_connection_that_the_client_resets_is_forgotten(loop: str) -> None:
    protocols: list[weakref.ref[HttpProtocol]] = []

    async def application(scope: Scope, receive: Receive, send: Send) -> None:
        request: RequestResponseCycle = send.__self__  # type: ignore[attr-defined]
        protocols.append(weakref.ref(request.on_response.__self__))  # type: ignore[attr-defined]
        await no_content(scope, receive, send)

    with serving(application, loop) as address:
        client = socket.create_connection(address)
        client.sendall(KEEP_ALIVE)
        answered(client)
        (forgotten,) = protocols
        assert isinstance(forgotten(), HttpProtocol)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
        until(lambda: gc.collect() >= 0 and forgotten() is None)


def test_an_address_of_another_machine_has_a_part_of_the_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    monkeypatch.setattr(uvicorn_http, "OF_ONE_ADDRESS", 3 / descriptors)
    monkeypatch.setattr(uvicorn_http, "_is_loopback", lambda _: False)
    addresses: WeakKeyDictionary[ServerState, Counter[str]] = WeakKeyDictionary()
    monkeypatch.setattr(uvicorn_http, "_addresses", addresses)  # of this server only
    with serving(no_content, "uvloop") as address:
        for _ in range(2):  # closed connections do not count
            clients = []
            for number in range(5):
                clients.append(socket.create_connection(address))
                with suppress(ConnectionError):
                    clients[-1].sendall(KEEP_ALIVE)
                    assert (answered(clients[-1]) != b"") == (number < 3)
            for client in clients:
                client.close()
            until(lambda: not any(addresses.values()))


def test_what_is_not_http_gets_an_error_of_the_api() -> None:
    with serving(no_content, "uvloop") as address, socket.create_connection(address) as client:
        client.sendall(b"\x16\x03\x01\x02\r\n\r\n")
        reply = answered(client)
    assert reply.startswith(b"HTTP/1.1 400 ")
    assert reply.count(b"\r\nx-content-type-options: nosniff\r\n") == 1


def test_browsers_do_not_guess_the_type_of_a_response() -> None:
    """Also after the server has made its default headers anew, which it does every second."""

    async def no_route(scope: Scope, receive: Receive, send: Send) -> None:
        await Response(status_code=404)(scope, receive, send)

    for application in (no_content, no_route):
        with serving(application, "uvloop") as address, httpx.Client(trust_env=False) as client:
            url = f"http://{address[0]}:{address[1]}/"
            dates = set()
            while len(dates) < 2:
                reply = client.get(url)
                assert reply.headers.get_list("x-content-type-options") == ["nosniff"]
                dates.add(reply.headers["date"])


def test_a_closed_socket_is_not_kept_listening() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        queue = AcceptQueue(server.getsockname()[1])
        address = server.getsockname()
    assert queue.take() is None
    with socket.socket() as probe:
        assert probe.connect_ex(address) != 0
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        assert not listens(bound.getsockname())


def test_connections_are_accepted_in_order() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=16) as server:
        server.setblocking(False)
        queue = AcceptQueue(server.getsockname()[1])
        assert queue.take() is None
        connections = [socket.create_connection(server.getsockname()) for _ in range(3)]
        for connection in connections:
            accepted = queue.take()
            assert accepted is not None
            assert accepted.getpeername() == connection.getsockname()
            assert not accepted.getblocking()
            accepted.close()
            connection.close()
        assert queue.take() is None
        del queue  # it closes no socket
        socket.create_connection(server.getsockname()).close()
        server.accept()[0].close()
