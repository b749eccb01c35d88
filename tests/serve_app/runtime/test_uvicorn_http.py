"""Concurrent clients are accepted at once, however long the event loop was busy."""

import asyncio
import socket
import threading
from collections.abc import Callable
from functools import partial

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from serve_app.runtime.uvicorn_http import HttpProtocol

CLIENTS = 40
PROTOCOL = partial(HttpProtocol, lambda: None)
REQUEST = b"GET / HTTP/1.1\r\nhost: here\r\nconnection: close\r\n\r\n"


class TurnCounting:
    """An application that records the turn of the event loop in which each request starts."""

    def __init__(self) -> None:
        self.turn = 0
        self.request_turns: list[int] = []
        self.loop: asyncio.AbstractEventLoop | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self.loop is None:
            self.loop = asyncio.get_running_loop()
            self._count()
        self.request_turns.append(self.turn)
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    def _count(self) -> None:
        assert self.loop is not None
        self.turn += 1
        self.loop.call_soon(self._count)


def receive_all(connection: socket.socket) -> bool:
    """The complete response, until the server closes the connection."""
    with connection:
        connection.settimeout(20)
        reply = b"".join(iter(lambda: connection.recv(4096), b""))
    return reply.startswith(b"HTTP/1.1 204")


def run_server(
    protocol: Callable[..., asyncio.Protocol], loop: str, run_client: Callable[[TurnCounting, tuple[str, int]], None]
) -> None:
    application = TurnCounting()
    config = uvicorn.Config(application, port=0, loop=loop, http=protocol, lifespan="off", log_config=None)  # type: ignore[arg-type]
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
    try:
        run_client(application, server.servers[0].sockets[0].getsockname())
    finally:
        server.should_exit = True
        thread.join(20)
    assert not thread.is_alive()


@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_clients_that_arrived_while_the_loop_was_busy_start_together(loop: str) -> None:
    def run_client(application: TurnCounting, address: tuple[str, int]) -> None:
        first = socket.create_connection(address)
        first.sendall(REQUEST)
        assert receive_all(first)
        assert application.loop is not None
        go_on = threading.Event()
        application.loop.call_soon_threadsafe(go_on.wait, 20)
        clients = [socket.create_connection(address) for _ in range(CLIENTS)]
        for client in clients:
            client.sendall(REQUEST)
        go_on.set()
        assert all(map(receive_all, clients))
        assert len(application.request_turns) == CLIENTS + 1
        assert application.request_turns[-1] - application.request_turns[1] < CLIENTS / 4, (
            "too many turns between the first and the last"
        )

    run_server(PROTOCOL, loop, run_client)


def test_a_stopping_server_accepts_no_connections() -> None:
    addresses: list[tuple[str, int]] = []

    def run_client(_: TurnCounting, address: tuple[str, int]) -> None:
        addresses.append(address)
        client = socket.create_connection(address)
        client.sendall(REQUEST)
        assert receive_all(client)

    run_server(PROTOCOL, "uvloop", run_client)
    with socket.socket() as probe:
        assert probe.connect_ex(addresses[0]) != 0
