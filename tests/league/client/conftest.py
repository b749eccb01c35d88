"""A replica's application behind a real socket, in a thread: what a client talks to. No Ray, no HAProxy."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import uvicorn

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Server
from serve_app.settings import ServeSettings
from tests.serve_app.conftest import QUICK
from tests.serve_app.inference_protocol.leagues import every_kind

SETTINGS = QUICK.model_copy(update={"max_body": 512 * 1024})


@pytest.fixture(scope="session")
def leagues(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    """Leagues of every kind, for tests that change nothing."""
    storage = Storage.at(tmp_path_factory.mktemp("client"))
    every_kind(storage).close()
    return storage


@pytest.fixture(scope="session")
def url(leagues: Storage) -> Iterator[str]:
    """A replica, for tests that change nothing."""
    with listening(leagues) as url:
        yield url


@contextmanager
def listening(storage: Storage, settings: ServeSettings = SETTINGS, port: int = 0) -> Iterator[str]:
    """A replica of its own, which listens while the context lasts; yields its URL."""
    application = Server(Registry.open(storage), settings, "replica-1").application()
    config = uvicorn.Config(
        application,
        host="127.0.0.1",
        port=port,
        log_level="warning",
        ws="websockets-sansio",
        timeout_graceful_shutdown=1,
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive(), "the server did not start"
            thread.join(0.01)
        (listener,) = server.servers
        yield f"http://127.0.0.1:{listener.sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()
