"""The search service in this process, without Ray."""

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from ray.exceptions import ActorDiedError
from starlette.testclient import TestClient

from evaluation.service.search_service import SearchService
from league.registry.registry import Registry
from serve_app.app import Replica
from serve_app.live_versions.remote_search import SearchClient
from serve_app.settings import ServeSettings
from tests.support.servers.replicas import QUICK, local_client


class LocalHandle:
    """Like the Ray Serve handle of the deployment. deaths: calls that end because the process ends."""

    def __init__(self, service: SearchService) -> None:
        self._service = service
        self.deaths = 0
        self.calls: list[str] = []

    def __getattr__(self, method: str) -> "_Method":
        return _Method(self, method)

    async def call(self, method: str, *args: object) -> Any:
        """Call a method of the service."""
        self.calls.append(method)
        if self.deaths:
            self.deaths -= 1
            raise ActorDiedError
        function: Callable[..., Awaitable[Any]] = getattr(self._service, method)
        return await function(*args)


class _Method:
    def __init__(self, handle: LocalHandle, name: str) -> None:
        self._handle, self._name = handle, name

    def remote(self, *args: object) -> Awaitable[Any]:
        return self._handle.call(self._name, *args)


def searching_server(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, settings: ServeSettings = QUICK
) -> tuple[Replica, LocalHandle]:
    """A replica with a search service, not started yet."""
    monkeypatch.setenv("LEAGUE_HOME", str(registry.storage.home))
    handle = LocalHandle(SearchService())
    client = SearchClient(handle, processes=1)
    return Replica(Registry.open(registry.storage), settings, "replica-1", search_client=client), handle


@contextmanager
def searching_replica(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, settings: ServeSettings = QUICK
) -> Iterator[tuple[TestClient, LocalHandle]]:
    """A client of a replica with a search service."""
    server, handle = searching_server(registry, monkeypatch, settings)
    with local_client(server) as client:
        yield client, handle
