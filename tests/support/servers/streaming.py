"""A replica's application on its own uvicorn, with our protocol classes, as Ray Serve runs it."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Replica
from serve_app.runtime import uvicorn_http, uvicorn_websocket
from serve_app.runtime.serve_bypass import ServeBypass
from serve_app.settings import ServeSettings
from tests.support.leagues.served_leagues import BOARD, promote, publish, register
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.prompt_uvicorn import Config, Server
from tests.support.servers.replicas import QUICK, UnavailableEvaluation
from tests.support.waiting import until


@dataclass
class Listening:
    """A running server."""

    url: str
    server: Replica
    uvicorn: Server

    def stream(self, model: str, query: str = "") -> str:
        """The URL of a stream."""
        return f"ws://{self.url.removeprefix('http://')}/v1/policies/{model}/stream{query}"

    def drain(self) -> None:
        """Stop the server, as Ray Serve stops a replica after HAProxy has removed it."""
        self.uvicorn.should_exit = True


@contextmanager
def listening(
    storage: Storage, settings: ServeSettings = QUICK, replica: str = "replica-1", port: int = 0, **options: Any
) -> Iterator[Listening]:
    """A replica in a thread, on a local port, by default a free one. Options are those of uvicorn."""
    server = Replica(Registry.open(storage), settings, replica, evaluation_client=UnavailableEvaluation())
    uvicorn_http.install(server.events.end)
    uvicorn_websocket.install(settings.max_body, settings.max_incomplete)
    application = ServeBypass(server.application())
    config = Config(application, port=port, log_config=None, log_level="critical", access_log=False, **options)
    runner = Server(config)
    thread = threading.Thread(target=runner.run, daemon=True)
    thread.start()
    until(lambda: runner.started or not thread.is_alive())
    assert runner.started
    port = runner.servers[0].sockets[0].getsockname()[1]
    try:
        yield Listening(f"http://127.0.0.1:{port}", server, runner)
    finally:
        with patch.object(uvicorn_websocket, "CLOSE_TIMEOUT", 0.2):  # for clients that do not answer
            runner.should_exit = True
            thread.join(240)
            assert not thread.is_alive()


@contextmanager
def connect_four_server(home: Path) -> Iterator[str]:
    """The URL of a server whose league connect_four has a champion, as the examples of the documentation need."""
    registry = Registry.open(Storage.at(home))
    register(registry, "connect_four", {"shared": BOARD})
    publish(registry, "connect_four", {"shared": masked_mlp()}, "run")
    promote(registry, "connect_four", 1)
    with listening(registry.storage) as listener:
        yield listener.url
    registry.close()
