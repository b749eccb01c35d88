"""Many clients at once are all seen at once, however long the event loop was busy."""

import asyncio
import socket
import threading
from collections.abc import Callable
from functools import partial

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from serve_app.http_protocol import HttpProtocol

CLIENTS = 40
PROTOCOL = partial(HttpProtocol, lambda: None)
REQUEST = b"GET / HTTP/1.1\r\nhost: here\r\nconnection: close\r\n\r\n"


class Counting:
    """An application that knows in which turn of the event loop each request begins."""

    def __init__(self) -> None:
        self.turn = 0
        self.seen: list[int] = []
        self.loop: asyncio.AbstractEventLoop | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self.loop is None:
            self.loop = asyncio.get_running_loop()
            self._count()
        self.seen.append(self.turn)
        await send({"type": "http.response.start", "status": 204, "headers": []})
        await send({"type": "http.response.body"})

    def _count(self) -> None:
        assert self.loop is not None
        self.turn += 1
        self.loop.call_soon(self._count)


def answered(connection: socket.socket) -> bool:
    """The whole reply, until the server hangs up."""
    with connection:
        connection.settimeout(20)
        reply = b"".join(iter(lambda: connection.recv(4096), b""))
    return reply.startswith(b"HTTP/1.1 204")


def served(
    protocol: Callable[..., asyncio.Protocol], loop: str, use: Callable[[Counting, tuple[str, int]], None]
) -> None:
    application = Counting()
    config = uvicorn.Config(application, port=0, loop=loop, http=protocol, lifespan="off", log_config=None)  # type: ignore[arg-type]
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
    try:
        use(application, server.servers[0].sockets[0].getsockname())
    finally:
        server.should_exit = True
        thread.join(20)
    assert not thread.is_alive()


@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_clients_that_came_while_the_loop_was_busy_begin_together(loop: str) -> None:
    def use(application: Counting, address: tuple[str, int]) -> None:
        first = socket.create_connection(address)
        first.sendall(REQUEST)
        assert answered(first)
        assert application.loop is not None
        go_on = threading.Event()
        application.loop.call_soon_threadsafe(go_on.wait, 20)
        clients = [socket.create_connection(address) for _ in range(CLIENTS)]
        for client in clients:
            client.sendall(REQUEST)
        go_on.set()
        assert all(map(answered, clients))
        assert len(application.seen) == CLIENTS + 1
        assert application.seen[-1] - application.seen[1] < CLIENTS / 4, "turns between the first and the last"

    served(PROTOCOL, loop, use)


def test_a_server_that_stops_accepts_no_more() -> None:
    taken: list[tuple[str, int]] = []

    def use(_: Counting, address: tuple[str, int]) -> None:
        taken.append(address)
        client = socket.create_connection(address)
        client.sendall(REQUEST)
        assert answered(client)

    served(PROTOCOL, "uvloop", use)
    with socket.socket() as probe:
        assert probe.connect_ex(taken[0]) != 0
