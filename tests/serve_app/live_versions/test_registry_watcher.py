"""A replica follows the registry, acknowledges its versions, and serves on without the registry."""

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import text, update
from sqlalchemy.orm import Session
from starlette.testclient import TestClient

from league.errors import NotReady, StorageError
from league.refs import CheckpointRef
from league.registry.aliases import AliasRepository
from league.registry.registry import Registry
from league.registry.storage.artifacts import ArtifactStore
from league.registry.storage.database import Database, clock
from league.registry.storage.manifest import Manifest
from league.registry.storage.rows import Acknowledgement, AliasTarget, Portion
from league.registry.storage.tables import ReplicaTable
from league.settings import Storage
from serve_app.app import Replica
from serve_app.runtime.replica_process import this_process
from tests.support.clients.actions import BOARD, act, version_for
from tests.support.databases import on_both_databases
from tests.support.leagues.served_leagues import BOARD as SPACES
from tests.support.leagues.served_leagues import promote, publish, register
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.replicas import QUICK, local_client, replica
from tests.support.waiting import until

pytestmark = on_both_databases


def acknowledgement(registry: Registry, league: str = "board") -> Acknowledgement | None:
    return next((row for row in registry.replicas.acknowledgements(league) if row.event), None)


def serves(registry: Registry, version: int) -> bool:
    return (row := acknowledgement(registry)) is not None and row.version == version


def test_a_replica_serves_and_acknowledges_what_the_registry_says(registry: Registry) -> None:
    with replica(registry.storage) as client:
        until(lambda: serves(registry, 1))
        row = acknowledgement(registry)
        assert row is not None
        assert (row.replica, row.sha256, row.fault) == ("replica-1", registry.versions.get("board", 1).sha256, None)
        assert acknowledgement(registry, "headless") is None
        assert client.get("/v1/health/ready").status_code == 200
        until(lambda: (again := acknowledgement(registry)) and again.seen_at > row.seen_at)
        for version in (2, 3, 2):
            promote(registry, "board", version)
            until(lambda version=version: serves(registry, version))
            assert act(client, observation=BOARD)["version"] == version
        registry.aliases.rollback("board", actor="test", reason="test")
        until(lambda: serves(registry, 3))
        assert act(client, observation=BOARD)["version"] == 3
    assert acknowledgement(registry) is None


def test_a_version_of_a_league_that_was_removed_and_trained_again_is_served(
    client: TestClient, registry: Registry
) -> None:
    """It has the number of an earlier one, which the replica has in memory."""
    assert act(client, version=2, observation=BOARD)["sha256"] == registry.versions.get("board", 2).sha256
    registry.removal.remove_league("board", force=True)
    until(lambda: client.post("/v1/policies/board/action", json={"observation": BOARD}).status_code == 404)
    register(registry, "board", {"shared": SPACES})
    again = [publish(registry, "board", {"shared": masked_mlp(seed=seed)}, f"again/{seed}").sha256 for seed in (7, 8)]
    promote(registry, "board", 1)
    until(lambda: serves(registry, 1))
    assert [act(client, version=version, observation=BOARD)["sha256"] for version in (1, 2)] == again
    assert act(client, observation=BOARD)["sha256"] == again[0]


def test_removed_and_retired_versions_in_memory_are_not_served(client: TestClient, registry: Registry) -> None:
    def status(version: int) -> int:
        return client.post(f"/v1/policies/board/action?version={version}", json={"observation": BOARD}).status_code

    assert [status(version) for version in (1, 2, 3)] == [200, 200, 200]
    registry.retention.retire("board", keep=1, before=datetime.now(UTC))
    until(lambda: [status(version) for version in (1, 2, 3)] == [200, 410, 200])
    registry.removal.remove_version(CheckpointRef("board", 3), force=True)
    until(lambda: [status(version) for version in (1, 2, 3)] == [200, 410, 404])


def test_the_canary_ends_when_its_version_is_removed(client: TestClient, registry: Registry) -> None:
    registry.traffic.set("board", canary=Portion(3, 1.0), actor="test", reason="test")
    until(lambda: version_for(client, "p") == 3)
    registry.removal.remove_version(CheckpointRef("board", 3), force=True)
    until(lambda: version_for(client, "p") == 1)
    until(lambda: (row := acknowledgement(registry)) and row.fault is None)


def test_a_tampered_champion_is_reported(client: TestClient, registry: Registry) -> None:
    (registry.artifacts.path("board", 2) / "shared.onnx").write_bytes(b"tampered")
    promote(registry, "board", 2)
    until(lambda: (row := acknowledgement(registry)) and row.fault)
    league = client.get("/v1/leagues/board").json()
    assert league["champion"] == 2
    (acknowledged,) = league["replicas"]
    assert acknowledged["version"] == 1
    assert acknowledged["fault"].startswith("champion: board/2/shared.onnx was changed")
    assert league["faults"]
    assert act(client, observation=BOARD)["version"] == 1
    reply = client.post("/v1/policies/board/action?version=2", json={"observation": BOARD})
    assert (reply.status_code, reply.json()["code"]) == (503, "artifact_corrupt")
    event = registry.aliases.rollback("board", actor="test", reason="test")
    assert registry.changes.wait_for_alias(event, 30) == ["replica-1"]
    row = acknowledgement(registry)
    assert row is not None
    assert (row.version, row.fault) == (1, None), "the fault ends with the difference from the registry"


def test_serving_continues_without_the_database(registry: Registry) -> None:
    server = Replica(Registry.open(registry.storage), QUICK, "replica-1")
    with local_client(server) as client:
        act(client, version=2, observation=BOARD)
        with outage(server.registry.database), outage(server.connection.database):
            until(lambda: client.get("/v1/leagues").json().get("code") == "storage_error")
            reply = client.get("/v1/leagues")
            assert (reply.status_code, int(reply.headers["retry-after"])) == (503, 1)
            assert str(registry.storage.home) not in reply.text
            assert act(client, observation=BOARD)["version"] == 1
            assert act(client, version=2, observation=BOARD)["version"] == 2
            reply = client.post("/v1/policies/board/action?version=3", json={"observation": BOARD})
            assert (reply.status_code, reply.json()["code"]) == (503, "storage_error")
            assert client.get("/v1/health/ready").status_code == 200
            promote(registry, "board", 3)
        until(lambda: serves(registry, 3))
        assert act(client, observation=BOARD)["version"] == 3


@contextmanager
def outage(database: Database) -> Iterator[None]:
    """Let each transaction fail."""

    @contextmanager
    def transaction() -> Iterator[Session]:
        raise StorageError("the database cannot be used: it is gone")
        yield

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "read", transaction)
        patch.setattr(database, "write", transaction)
        yield


def test_serving_continues_without_the_artifacts(client: TestClient, registry: Registry) -> None:
    registry.artifacts.root.rename(registry.artifacts.root.with_name("elsewhere"))
    promote(registry, "board", 2)
    until(lambda: (row := acknowledgement(registry)) and row.fault)
    assert act(client, observation=BOARD)["version"] == 1
    registry.artifacts.root.with_name("elsewhere").rename(registry.artifacts.root)
    until(lambda: serves(registry, 2))


def test_an_empty_registry_replacing_the_followed_one_is_ignored(
    registry: Registry, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It has no keys, which would unlock the server."""
    if is_server(registry):
        pytest.skip("a database that is a file can be replaced")
    _, token = registry.keys.create("bot", ["act", "read"])
    with replica(registry.storage) as client:
        client.headers["x-api-key"] = token
        assert act(client, observation=BOARD)["version"] == 1
        Registry.open(Storage.at(tmp_path / "other")).close()
        home = registry.storage.home
        home.rename(tmp_path / "away")
        (tmp_path / "other").rename(home)
        until(lambda: "it is a different database" in caplog.text)
        assert client.get("/v1/leagues").json() == {"leagues": [], "next": None}
        assert act(client, observation=BOARD)["version"] == 1
        assert client.get("/v1/leagues", headers={"x-api-key": ""}).status_code == 401
        shutil.rmtree(home)
        (tmp_path / "away").rename(home)
        promote(registry, "board", 2)
        until(lambda: act(client, observation=BOARD)["version"] == 2)


def is_server(registry: Registry) -> bool:
    return registry.database.engine.dialect.name == "postgresql"


def backdate(registry: Registry, replica: str, seconds: float) -> None:
    with registry.database.write() as session:
        seen_at = clock(session) - timedelta(seconds=seconds)
        session.execute(update(ReplicaTable).filter_by(replica=replica).values(seen_at=seen_at))


def names(registry: Registry) -> set[str]:
    return {row.replica for row in registry.replicas.registered()}


def test_a_replica_registers_before_it_reads_the_aliases(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise it could read an alias, and a promotion of that moment would wait for all replicas but this one."""
    registered: list[set[str]] = []
    read = AliasRepository.all

    def observed(aliases: AliasRepository) -> dict[tuple[str, str], AliasTarget]:
        # Servers of other tests in this process read their own database at the same time.
        if aliases._database.engine.url == registry.aliases._database.engine.url:
            registered.append(names(registry))
        return read(aliases)

    monkeypatch.setattr(AliasRepository, "all", observed)
    with replica(registry.storage):
        pass
    assert registered[0] == {"replica-1"}
    assert names(registry) == set()


def test_replicas_that_ended_are_removed_and_silent_ones_are_not(registry: Registry) -> None:
    description = dict(this_process().description)
    machine, pid, _ = description["process"].rsplit(":", 2)
    processes = {
        "ended": {"process": f"{machine}:{pid}:1"},
        "stuck": description,
        "elsewhere": {"process": f"another:{pid}:1"},
    }
    for name, process in processes.items():
        registry.replicas.register(name, process)
        backdate(registry, name, 2)  # a few heartbeats
    registry.replicas.register("elsewhere for a day", processes["elsewhere"])
    backdate(registry, "elsewhere for a day", 25 * 3600)
    with replica(registry.storage):
        until(lambda: names(registry) == {"replica-1", "stuck", "elsewhere"})


def test_a_stalled_load_delays_neither_other_leagues_nor_acknowledgements(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, read = threading.Event(), ArtifactStore.read

    def stalled(artifacts: ArtifactStore, manifest: Manifest, name: str) -> bytes:
        if (manifest.league, manifest.version) == ("board", 2):
            assert gate.wait(60)
        return read(artifacts, manifest, name)

    monkeypatch.setattr(ArtifactStore, "read", stalled)
    with replica(registry.storage) as client:
        promote(registry, "board", 2)
        event = registry.aliases.history("board")[0]
        until(lambda: (row := acknowledgement(registry)) and (row.event or 0) >= event.id)
        with pytest.raises(NotReady, match="replica-1 serves version 1"):
            registry.changes.wait_for_alias(event, 0)
        other = registry.aliases.set("vector", "candidate", 1, expected=None, actor="test", reason="test")
        assert registry.changes.wait_for_alias(other, 30) == ["replica-1"]
        promote(registry, "board", 3)
        assert registry.changes.wait_for_alias(registry.aliases.history("board")[0], 30) == ["replica-1"]
        assert act(client, observation=BOARD)["version"] == 3
        gate.set()


def test_a_replica_that_was_taken_for_dead_registers_and_acknowledges_again(registry: Registry) -> None:
    (registry.artifacts.path("vector", 1) / "shared.onnx").write_bytes(b"tampered")
    with replica(registry.storage):
        until(lambda: serves(registry, 1))
        registry.replicas.remove("replica-1")
        until(lambda: serves(registry, 1))
        until(lambda: (row := acknowledgement(registry, "vector")) and row.fault)
        promote(registry, "board", 2)
        until(lambda: serves(registry, 2))


def named(storage: Storage, name: str) -> Storage:
    """The storage, whose connections have a name in PostgreSQL."""
    return replace(storage, database_url=f"{storage.database_url}&application_name={name}")


def processes(registry: Registry, name: str) -> list[int]:
    """The processes of PostgreSQL for connections with a name."""
    with registry.database.read() as session:
        return list(session.scalars(text("SELECT pid FROM pg_stat_activity WHERE application_name = :n"), {"n": name}))


@pytest.mark.slow
@pytest.mark.e2e
def test_postgresql_notifies_replicas(registry: Registry) -> None:
    if not is_server(registry):
        pytest.skip("SQLite is polled")
    seldom = QUICK.model_copy(update={"poll": 600.0, "poll_slowest": 600.0, "heartbeat": 600.0})
    with replica(registry.storage, seldom):
        for version in (2, 3):
            promote(registry, "board", version)
            until(lambda version=version: serves(registry, version))


def test_an_idle_replica_has_one_connection_and_replaces_a_lost_one(registry: Registry) -> None:
    if not is_server(registry):
        pytest.skip("SQLite has no server")
    with replica(named(registry.storage, "idle")) as client:
        assert client.get("/v1/leagues").status_code == 200
        lost: list[int] = []

        def has_one_connection() -> bool:
            lost[:] = processes(registry, "idle")
            return len(lost) == 1

        until(has_one_connection)
        with registry.database.write() as session:
            session.execute(text("SELECT pg_terminate_backend(:process)"), {"process": lost[0]})
        until(lambda: lost[0] not in processes(registry, "idle"))
        promote(registry, "board", 2)
        until(lambda: serves(registry, 2))
