"""A replica's application on a uvicorn of its own, as Ray Serve starts it: with our protocols."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import uvicorn

from league.registry.registry import Registry
from league.settings import Storage
from serve_app import http_protocol, websocket_protocol
from serve_app.app import Server
from serve_app.settings import ServeSettings
from tests.serve_app.conftest import QUICK, Closed


@dataclass
class Listening:
    """A server that listens."""

    url: str
    server: Server
    uvicorn: uvicorn.Server

    def stream(self, model: str, query: str = "") -> str:
        """The address of a stream."""
        return f"ws://{self.url.removeprefix('http://')}/v1/policies/{model}/stream{query}"

    def drain(self) -> None:
        """What Ray Serve does with a replica that is to stop, once HAProxy has forgotten it."""
        self.uvicorn.should_exit = True


@contextmanager
def listening(
    storage: Storage, settings: ServeSettings = QUICK, replica: str = "replica-1", port: int = 0, **options: Any
) -> Iterator[Listening]:
    """A replica in a thread of its own, on a port of this machine, by default a free one. options: of uvicorn."""
    server = Server(Registry.open(storage), settings, replica, studio=Closed())
    http_protocol.install(server.events.end)
    websocket_protocol.install(settings.max_body)
    config = uvicorn.Config(
        server.application(), port=port, log_config=None, log_level="critical", access_log=False, **options
    )
    runner = uvicorn.Server(config)
    thread = threading.Thread(target=runner.run, daemon=True)
    thread.start()
    while not runner.started:
        assert thread.is_alive()
    port = runner.servers[0].sockets[0].getsockname()[1]
    try:
        yield Listening(f"http://127.0.0.1:{port}", server, runner)
    finally:
        runner.should_exit = True
        thread.join(20)
        assert not thread.is_alive()
