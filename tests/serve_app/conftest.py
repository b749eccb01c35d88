from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from league.errors import NoStudio
from league.games import Order
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Server
from serve_app.settings import ServeSettings
from serve_app.studio import Answer
from tests.serve_app.leagues import everything

QUICK = ServeSettings(poll=0.01, poll_slowest=0.05, retry=0.05, heartbeat=0.2, max_body=64 * 1024, max_batch=8)
"""A replica's settings for tests: it looks often, gives up early, and refuses soon."""


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Leagues of every kind, for a test that changes them."""
    registry = everything(Storage.at(tmp_path / "home"))
    yield registry
    registry.close()


@pytest.fixture
def client(registry: Registry) -> Iterator[TestClient]:
    """A replica's application, without Ray, that follows `registry`."""
    with replica(registry.storage) as client:
        yield client


@pytest.fixture(scope="session")
def storage(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    """Leagues of every kind, for tests that change nothing."""
    storage = Storage.at(tmp_path_factory.mktemp("leagues"))
    everything(storage).close()
    return storage


@pytest.fixture(scope="session")
def unchanging(storage: Storage) -> Iterator[TestClient]:
    """A replica's application for tests that change nothing."""
    with replica(storage) as client:
        yield client


def replica(storage: Storage, settings: ServeSettings = QUICK) -> TestClient:
    """The application of a replica of its own; enter it to start."""
    return TestClient(Server(Registry.open(storage), settings, "replica-1", studio=Closed()).application())


class Closed:
    """A studio where nobody is at work: what is asked of it waits in the registry."""

    def look(self) -> None:
        """Do nothing."""

    async def ask(self, order: Order) -> Answer:
        """Nobody is here."""
        raise NoStudio("nobody is at work")
