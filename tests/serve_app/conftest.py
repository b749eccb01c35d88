from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.runtime import haproxy
from serve_app.runtime.launch import running
from tests.support.databases import StorageAt
from tests.support.leagues import tictactoe
from tests.support.leagues.protocol_leagues import every_kind
from tests.support.leagues.served_leagues import everything
from tests.support.servers.replicas import READ_ONLY, replica
from tests.support.servers.under_load import NO_SHEDDING, RayServer, deploy_file, processes, serving
from tests.support.waiting import until


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture
def registry(tmp_path: Path, storage_at: StorageAt) -> Iterator[Registry]:
    """Leagues of each kind, for a test that changes them."""
    registry = everything(storage_at(tmp_path / "home"))
    yield registry
    registry.close()


@pytest.fixture
def client(registry: Registry) -> Iterator[TestClient]:
    """A replica's application, without Ray, that follows `registry`."""
    with replica(registry.storage) as client:
        yield client


@pytest.fixture(scope="session")
def storage(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    """Leagues of each kind, for tests that do not change them."""
    storage = Storage.at(tmp_path_factory.mktemp("leagues"))
    everything(storage).close()
    return storage


@pytest.fixture(scope="session")
def read_only_client(storage: Storage) -> Iterator[TestClient]:
    """A replica's application for tests that do not change its data."""
    with replica(storage, READ_ONLY) as client:
        yield client


@pytest.fixture(scope="session")
def leagues(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    """Leagues with each type of tensors, for tests that do not change them."""
    storage = Storage.at(tmp_path_factory.mktemp("kinds"))
    every_kind(storage).close()
    return storage


@pytest.fixture
def promoter(registry: Registry) -> Iterator[TestClient]:
    """A replica, called with a key that may promote."""
    _, token = registry.keys.create("release-bot", ["promote", "read", "act"])
    with replica(registry.storage) as client:
        client.headers["authorization"] = f"Bearer {token}"
        yield client


@pytest.fixture(scope="session")
def ray_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RayServer]:
    """Ray Serve, HAProxy and two replicas. One server for all tests that need a real one; keys are not required."""
    registry = every_kind(Storage.at(tmp_path_factory.mktemp("served")))
    tictactoe.playable(registry)
    deploy = deploy_file(registry.storage.home, NO_SHEDDING)
    (grpc_port,) = haproxy.free_ports(1, "127.0.0.1")
    with pytest.MonkeyPatch.context() as environment:
        # The default keeps a replica that stops open for 30 s.
        environment.setenv("RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S", "2")
        with running(registry.storage, replicas=2, grpc_port=grpc_port, insecure=True, deploy=deploy) as url:
            until(lambda: serving(registry, 1) == 2)
            yield RayServer(url, f"127.0.0.1:{grpc_port}", registry, deploy)
    until(lambda: not processes(registry.storage, ""))  # no process outlives the server
    registry.close()
