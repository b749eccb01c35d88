"""The server for client tests: a replica's application on a real socket, without Ray and HAProxy."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from league.registry.registry import Registry
from league.settings import Storage
from policy_league_client import AsyncClient, Client, retries
from tests.support.clients.sync_and_async import SETTINGS, Connect, Synchronous
from tests.support.leagues.protocol_leagues import every_kind
from tests.support.leagues.served_leagues import everything
from tests.support.servers.streaming import Listening, listening

PATIENCE = 240.0
"""Seconds for what succeeds."""


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine, a replica that listens may not be ready for more than a second."""
    monkeypatch.setattr(retries, "NOT_READY_DEADLINE", PATIENCE)


@pytest.fixture(params=[Client, AsyncClient], ids=["sync", "async"])
def connect(request: pytest.FixtureRequest) -> Iterator[Connect]:
    """Creates clients of both kinds, which wait for as long as a busy machine may take."""
    clients: list[Any] = []
    with asyncio.Runner() as runner:

        def connect_client(*args: Any, **options: Any) -> Any:
            client = request.param(*args, **{"timeout": PATIENCE, "retry_deadline": PATIENCE, **options})
            clients.append(Synchronous(client, runner) if request.param is AsyncClient else client)
            return clients[-1]

        yield connect_client
        for client in clients:
            client.close()


@pytest.fixture(scope="session")
def leagues(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    """Leagues of each kind, for tests that do not change them."""
    storage = Storage.at(tmp_path_factory.mktemp("client"))
    every_kind(storage).close()
    return storage


@pytest.fixture(scope="session")
def url(leagues: Storage) -> Iterator[str]:
    """A replica, for tests that do not change its data."""
    with listening(leagues, SETTINGS) as listener:
        yield listener.url


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Leagues of each kind, for a test that changes them."""
    registry = everything(Storage.at(tmp_path / "home"))
    yield registry
    registry.close()


@pytest.fixture
def listener(registry: Registry) -> Iterator[Listening]:
    """A replica that follows `registry`."""
    with listening(registry.storage) as listener:
        yield listener
