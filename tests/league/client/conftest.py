"""What a client talks to: a replica's application behind a real socket. No Ray, no HAProxy."""

import asyncio
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from league.client import AsyncClient, Client
from league.registry.registry import Registry
from league.settings import Storage
from tests.serve_app.conftest import QUICK
from tests.serve_app.inference_protocol.leagues import every_kind
from tests.serve_app.leagues import everything
from tests.serve_app.streaming import Listening, listening

SETTINGS = QUICK.model_copy(update={"max_body": 512 * 1024})

Connect = Callable[..., Client]


class Awaited:
    """An AsyncClient, stream or episode whose every method waits for its result, so that one test does for both."""

    def __init__(self, awaited: Any, runner: asyncio.Runner) -> None:
        self._awaited = awaited
        self._runner = runner

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._awaited, name)
        if not callable(found):
            return found
        return lambda *args, **options: self._waited_for(found(*args, **options))

    def __enter__(self) -> "Awaited":
        self._runner.run(self._awaited.__aenter__())
        return self

    def __exit__(self, *error: Any) -> None:
        self._runner.run(self._awaited.__aexit__(*error))

    def _waited_for(self, result: Any) -> Any:
        if inspect.iscoroutine(result):
            return self._runner.run(result)
        return Awaited(result, self._runner) if hasattr(result, "__aenter__") else result


@pytest.fixture(params=[Client, AsyncClient], ids=["sync", "async"])
def connect(request: pytest.FixtureRequest) -> Iterator[Connect]:
    """Makes clients of either kind."""
    made: list[Any] = []
    with asyncio.Runner() as runner:

        def connected(*args: Any, **options: Any) -> Any:
            client = request.param(*args, **options)
            made.append(Awaited(client, runner) if request.param is AsyncClient else client)
            return made[-1]

        yield connected
        for client in made:
            client.close()


@pytest.fixture(scope="session")
def leagues(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    """Leagues of every kind, for tests that change nothing."""
    storage = Storage.at(tmp_path_factory.mktemp("client"))
    every_kind(storage).close()
    return storage


@pytest.fixture(scope="session")
def url(leagues: Storage) -> Iterator[str]:
    """A replica, for tests that change nothing."""
    with listening(leagues, SETTINGS) as listener:
        yield listener.url


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Leagues of every kind, for a test that changes them."""
    registry = everything(Storage.at(tmp_path / "home"))
    yield registry
    registry.close()


@pytest.fixture
def listener(registry: Registry) -> Iterator[Listening]:
    """A replica that follows `registry`."""
    with listening(registry.storage) as listener:
        yield listener
