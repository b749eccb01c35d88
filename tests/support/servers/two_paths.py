"""A replica on two ports, with the fast path of inference and without it, and generated requests to compare them."""

import asyncio
import json
import random
import socket
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import numpy as np
import uvicorn
from numpy.typing import NDArray
from uvicorn.server import ServerState

from benchmarks.load.http import JSON, binary, post
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Replica
from serve_app.inference.plain_format import PlainRequest
from serve_app.routes.plain_action import PlainActions
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
        self.answered: list[PlainRequest] = []
        """By the fast path."""
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
        plain = self.server.plain_actions
        assert plain is not None
        reply = plain._reply

        def record(request: PlainRequest, head: bytes, content: bytes) -> None:
            self.answered.append(request)
            reply(request, head, content)

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

    async def _listen(self, config: uvicorn.Config, plain: PlainActions | None) -> asyncio.Server:
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


def generated(generator: random.Random) -> bytes:
    """A request, mostly a plain one, often with a flaw."""
    return (_generated_json if generator.random() < 0.5 else _generated_binary)(generator)


def _generated_json(generator: random.Random) -> bytes:
    model, body = generator.choice(
        [
            ("board", {"observation": boards(1, generator.randrange(99))[0]}),
            ("board", {"observations": boards(generator.randint(1, 8), generator.randrange(99))}),
            ("vector", {"observation": [generator.uniform(-2, 2), generator.randint(-2, 2)]}),
            ("vector", {"observations": [[generator.choice([0, 1, 1e-3, 1e30, 2**60 + 1]), 0.5]]}),
            ("nested", {"observation": {"mode": generator.randint(0, 4), "sense": {"speed": [0.5, 2]}}}),
            ("nested", {"observation": {"mode": generator.choice([1.0, 2.5, True, 2**60 + 1, 1e18]), "sense": {}}}),
        ]
    )
    content = json.dumps(body).encode()
    headers, query = dict(JSON), ""
    match generator.randrange(12):
        case 0:
            place = generator.randrange(len(content))
            content = content[:place] + generator.randbytes(1) + content[place + 1 :]
        case 1:
            content = content[: generator.randrange(len(content))]
        case 2:
            content = content.replace(b"1", generator.choice([b"true", b"1.0", b"1.5", b"null", b'"1"', b"[1]"]), 1)
        case 3:
            headers |= generator.choice([{"Origin": "http://localhost"}, {"X-League-Key": "a"}, {"Accept": "*/*"}])
        case 4:
            model, query = generator.choice(["board", "vector", "duo", "board.shared"]), generator.choice(["", "?a=b"])
    return request(content, model, headers, query)


def _generated_binary(generator: random.Random) -> bytes:
    rows, numbers = generator.choice([1, 1, 1, 2, 8, 9]), np.random.default_rng(generator.randrange(99))
    speeds = numbers.normal(size=(rows, 2)).astype(np.float32)
    speeds[0, 0] = generator.choice([0, 1, 1e30, np.nan, np.inf]) if generator.random() < 0.1 else speeds[0, 0]
    modes = numbers.integers(1, 4 if generator.random() < 0.9 else 9, rows)
    model, arrays = generator.choice(
        [
            ("board", binary_boards(rows, generator.randrange(99))),
            ("vector", {"observation": speeds}),
            ("nested", {"observation.sense.speed": speeds, "observation.mode": modes}),
        ]
    )
    outputs = generator.choice([["action"], [], ["action_dist_inputs"]] if model == "nested" else [["action"]])
    body, headers = binary(arrays, outputs)
    match generator.randrange(12):
        case 0:
            place = generator.randrange(len(body))
            body = body[:place] + generator.randbytes(1) + body[place + 1 :]
        case 1:
            body = body[: generator.randrange(len(body))]
        case 2:
            body += generator.randbytes(generator.randint(1, 9))
        case 3:
            length = generator.choice([0, 7, len(body), len(body) + 1, 10**11, "soon", ""])
            headers["Inference-Header-Content-Length"] = str(length)
        case 4:
            model = generator.choice(["nobody", "duo", "duo.left", "board.shared", "memory", "board/versions/2"])
        case 5:
            headers |= generator.choice([{"Accept-Encoding": "gzip"}, {"Origin": "http://localhost"}])
        case 6:
            flaws = {b"binary_data_size": b"classification", b"action": b"answer", b"true": b"false", b"INT8": b"BOOL"}
            old, new = generator.choice(list(flaws.items()))
            changed = body.replace(old, new)
            length = int(headers["Inference-Header-Content-Length"]) + len(changed) - len(body)
            body, headers = changed, headers | {"Inference-Header-Content-Length": str(length)}
    return post(f"http://localhost/v2/models/{model}/infer", body, headers)


def differences(replica: Connections, generator: random.Random) -> tuple[int, list[tuple[bytes, bytes]]]:
    """Send some generated requests to both paths. Returns their number, and the answers that differ."""
    requests = [generated(generator) for _ in range(generator.choice([1, 2, 7]))]
    answers = zip(*(together(replica, address, requests) for address in (replica.fast, replica.general)), strict=True)
    return len(requests), [(fast, general) for fast, general in answers if fast != general]
