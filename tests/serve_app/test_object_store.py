"""A replica whose versions are in an object store: faults of the store cost no action."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from league.registry.registry import Registry
from league.settings import Storage
from tests.support.clients.actions import BOARD, act
from tests.support.leagues.served_leagues import BOARD as SPACES
from tests.support.leagues.served_leagues import promote, publish, register
from tests.support.policies.graphs import masked_mlp
from tests.support.servers import object_store
from tests.support.servers.replicas import replica
from tests.support.waiting import until


@dataclass
class Store:
    """A running store. url: of its artefacts; the environment has its credentials."""

    running: ExitStack
    endpoint: str
    url: str

    @contextmanager
    def unreachable(self) -> Iterator[None]:
        """Stop the server for a while."""
        self.running.close()
        yield
        self.running.enter_context(object_store.server(int(self.endpoint.rpartition(":")[2])))


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    with ExitStack() as running:
        endpoint = running.enter_context(object_store.server())
        for name, value in object_store.variables(endpoint).items():
            monkeypatch.setenv(name, value)
        yield Store(running, endpoint, object_store.create_bucket(endpoint))


def test_a_fault_of_the_store_costs_no_action(store: Store, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The fault is in the log, in one line, and callers see that there is one."""
    publisher = Storage(tmp_path / "home", Storage.at(tmp_path / "home").database_url, store.url)
    registry = Registry.open(publisher)
    register(registry, "board", {"shared": SPACES})
    for seed in range(2):
        publish(registry, "board", {"shared": masked_mlp(seed=seed)}, f"run/{seed}")
    promote(registry, "board", 1)
    with replica(Storage(tmp_path / "replica", publisher.database_url, store.url)) as client:
        assert act(client, observation=BOARD)["version"] == 1
        with store.unreachable():
            promote(registry, "board", 2)
            until(lambda: client.get("/v1/leagues/board").json()["faults"])
            lines = [line for line in caplog.messages if "cannot switch to version 2, version 1 stays" in line]
            assert "cannot be used: check network and credentials" in lines[0]
            assert "\n" not in lines[0]
            assert act(client, observation=BOARD)["version"] == 1
        until(lambda: act(client, observation=BOARD)["version"] == 2)
    registry.close()
