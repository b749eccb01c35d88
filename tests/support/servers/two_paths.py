"""A replica on two ports, with the fast path of inference and without it."""

import asyncio
import json
import socket
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import uvicorn
from numpy.typing import NDArray
from uvicorn.server import ServerState

from benchmarks.load.http import JSON, binary, post
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Replica
from serve_app.routes.inference_queue import InferenceQueue
from serve_app.runtime.uvicorn_http import HttpProtocol
from serve_app.settings import ServeSettings
from tests.support.clients.actions import board_arrays, boards
from tests.support.leagues.served_leagues import everything
from tests.support.servers.replicas import QUICK
from tests.support.waiting import until

NONE: Mapping[str, str] = {}


class Connections:
    """A replica in a thread, on two ports: with the fast path, and without it."""

    def __init__(self, server: Replica) -> None:
        self.server = server
        self.answered: list[tuple[HttpProtocol, int]] = []
        """Connections and status of the answers of the fast path."""
        self.fast, self.general = ("", 0), ("", 0)
        self._started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)

    def __enter__(self) -> "Connections":
        self._thread.start()
        while not self._started.wait(1):
            assert self._thread.is_alive(), "the replica did not start"
        return self

    def __exit__(self, *_: object) -> None:
        self.loop.call_soon_threadsafe(self._end.set)
        self._thread.join()

    async def _run(self) -> None:
        self.loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        plain = self.server.inference_queue
        assert plain is not None
        reply = plain._reply

        def record(connection: HttpProtocol, status: int, *rest: Any) -> None:
            self.answered.append((connection, status))
            reply(connection, status, *rest)

        plain._reply = record  # type: ignore[method-assign]
        application = self.server.application()
        config = uvicorn.Config(application, log_config=None, lifespan="off")
        async with application.router.lifespan_context(application):
            ports = [await self._listen(config, path) for path in (plain, None)]
            self.fast, self.general = (port.sockets[0].getsockname() for port in ports)
            self._started.set()
            await self._end.wait()
            for port in ports:
                port.close()

    async def _listen(self, config: uvicorn.Config, plain: InferenceQueue | None) -> asyncio.Server:
        protocol = partial(HttpProtocol, lambda: None, plain, config, ServerState(), {})
        return await self.loop.create_server(protocol, "127.0.0.1", 0)

    @contextmanager
    def busy(self) -> Iterator[None]:
        """Keep the event loop busy: what arrives meanwhile arrives in one turn."""
        is_busy, go_on = threading.Event(), threading.Event()

        def wait() -> None:
            is_busy.set()
            go_on.wait()

        self.loop.call_soon_threadsafe(wait)
        is_busy.wait()
        try:
            yield
        finally:
            go_on.set()


@contextmanager
def changing(storage: Storage, settings: ServeSettings = QUICK) -> Iterator[tuple[Connections, Registry]]:
    registry = everything(storage)
    with Connections(Replica(Registry.open(storage), settings, "replica-1")) as connections:
        until(lambda: connections.server.alias_slots.champion("board") is not None)
        yield connections, registry
    registry.close()


def request(body: Any, model: str = "board", headers: dict[str, str] = JSON, query: str = "") -> bytes:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return post(f"http://localhost/v1/policies/{model}/action{query}", content, headers)


def receive(connection: socket.socket, count: int = 1) -> bytes:
    """The bytes of `count` responses with a Content-Length."""
    connection.settimeout(60)
    received, begin = b"", 0
    for _ in range(count):
        while (end := received.find(b"\r\n\r\n", begin)) < 0:
            received += _part(connection)
        length = int(received[begin:end].lower().partition(b"content-length: ")[2].partition(b"\r\n")[0])
        while len(received) < end + 4 + length:
            received += _part(connection)
        begin = end + 4 + length
    return received


def _part(connection: socket.socket) -> bytes:
    data = connection.recv(65536)
    assert data, "the server closed the connection"
    return data


def exchange(address: tuple[str, int], data: bytes) -> bytes:
    with socket.create_connection(address) as connection:
        connection.sendall(data)
        return receive(connection)


def together(replica: Connections, address: tuple[str, int], requests: list[bytes]) -> list[bytes]:
    """The responses to requests on a connection each, which arrive in one turn."""
    with ExitStack() as stack:
        connections = [stack.enter_context(socket.create_connection(address)) for _ in requests]
        for connection in connections:  # the server has accepted it
            connection.sendall(b"GET /v1/health/live HTTP/1.1\r\nhost: localhost\r\n\r\n")
            receive(connection)
        with replica.busy():
            for connection, data in zip(connections, requests, strict=True):
                connection.sendall(data)
        return [receive(connection) for connection in connections]


def infer(
    arrays: Mapping[str, NDArray], model: str = "board", outputs: Sequence[str] = (), more: Mapping[str, str] = NONE
) -> bytes:
    """A request of the Open Inference Protocol with binary tensors. outputs: all by default. more: headers."""
    body, headers = binary(arrays, outputs)
    return post(f"http://localhost/v2/models/{model}/infer", body, headers | more)


def binary_boards(rows: int, seed: int = 0) -> dict[str, NDArray]:
    """The inputs of the league `board`."""
    return board_arrays(boards(rows, seed))
