from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pytest
from sqlalchemy import update

from league.errors import UnknownLeague
from league.registry import replicas
from league.registry.registry import Registry
from league.registry.replicas import LIVENESS_TIMEOUT
from league.registry.storage import database
from league.registry.storage.database import clock
from league.registry.storage.tables import ReplicaTable
from tests.support.leagues.registries import LEAGUE, registered


def backdate(registry: Registry, replica: str, by: timedelta) -> None:
    with registry.database.write() as session:
        session.execute(update(ReplicaTable).filter_by(replica=replica).values(seen_at=clock(session) - by))


def test_a_replica_reports_its_version_repeatedly(registry: Registry) -> None:
    registry.replicas.acknowledge("replica-1", LEAGUE, None, None, fault="tictactoe@1: manifest.json is missing")
    registry.replicas.acknowledge("replica-2", LEAGUE, 1, "abc")
    registry.replicas.acknowledge("replica-1", LEAGUE, 2, "def")
    found = registry.replicas.acknowledgements(LEAGUE)
    assert [(row.replica, row.version, row.sha256, row.fault) for row in found] == [
        ("replica-1", 2, "def", None),
        ("replica-2", 1, "abc", None),
    ]
    assert all(datetime.now(UTC) - row.seen_at < timedelta(minutes=1) for row in found)


def test_faults_are_stored(registry: Registry) -> None:
    registry.replicas.acknowledge("replica-1", LEAGUE, 1, "abc", fault="tictactoe@2: shared.onnx was changed")
    (row,) = registry.replicas.acknowledgements(LEAGUE)
    assert (row.version, row.fault) == (1, "tictactoe@2: shared.onnx was changed")


def test_a_silent_replica_is_listed_and_removed_after_a_day(registry: Registry) -> None:
    registry.replicas.acknowledge("silent", LEAGUE, 1, "abc")
    backdate(registry, "silent", timedelta(hours=23))
    registry.replicas.register("alive", {})
    silent = {row.replica: row.silence for row in registry.replicas.acknowledgements(LEAGUE)}
    assert silent["alive"] < timedelta(minutes=1) < timedelta(hours=22) < silent["silent"]
    backdate(registry, "silent", timedelta(hours=25))
    registry.replicas.register("alive", {})
    assert [row.replica for row in registry.replicas.registered()] == ["alive"]


def test_a_registered_replica_is_listed_before_it_serves_a_league(registry: Registry) -> None:
    registry.replicas.register("replica-1", {"machine": "here"})
    (row,) = registry.replicas.acknowledgements(LEAGUE)
    assert (row.replica, row.version, row.aliases, row.event) == ("replica-1", None, {}, None)
    (replica,) = registry.replicas.registered()
    assert (replica.process, replica.seen_at) == ({"machine": "here"}, row.seen_at)


def test_an_acknowledgement_registers_again(registry: Registry) -> None:
    """Another replica may take one for dead that is not."""
    registry.replicas.register("replica-1", {"machine": "here"})
    registry.replicas.remove("replica-1")
    registry.replicas.acknowledge("replica-1", LEAGUE, 1, "abc", event=7)
    (row,) = registry.replicas.acknowledgements(LEAGUE)
    assert (row.replica, row.version, row.event) == ("replica-1", 1, 7)


@pytest.mark.parametrize("hours", [-1, 1, 25])
def test_times_are_those_of_the_database(registry: Registry, monkeypatch: pytest.MonkeyPatch, hours: int) -> None:
    """A replica whose clock is wrong is seen alive, and removes nobody."""
    if registry.database.engine.dialect.name == "sqlite":
        pytest.skip("with SQLite, the clock of the machine is that of the database")
    registry.replicas.register("replica-1", {})
    clock_of_replica = SimpleNamespace(now=lambda zone: datetime.now(zone) + timedelta(hours=hours))
    for module in (database, replicas):
        monkeypatch.setattr(module, "datetime", clock_of_replica, raising=False)
    registry.replicas.acknowledge("replica-2", LEAGUE, 1, "abc")
    registry.replicas.register("replica-2", {})
    monkeypatch.undo()
    found = registry.replicas.acknowledgements(LEAGUE)
    assert [row.replica for row in found] == ["replica-1", "replica-2"]
    assert all(abs(row.silence) < LIVENESS_TIMEOUT for row in found)


def test_a_stopped_replica_is_deleted(registry: Registry) -> None:
    registered(registry, "another")
    registry.replicas.acknowledge("replica-1", LEAGUE, 1, "abc")
    registry.replicas.acknowledge("replica-1", "another", 1, "abc")
    registry.replicas.acknowledge("replica-2", LEAGUE, 1, "abc")
    registry.replicas.remove("replica-1")
    assert [row.replica for row in registry.replicas.acknowledgements(LEAGUE)] == ["replica-2"]
    assert [row.replica for row in registry.replicas.acknowledgements("another")] == ["replica-2"]


def test_an_unknown_league_is_rejected(registry: Registry) -> None:
    with pytest.raises(UnknownLeague):
        registry.replicas.acknowledge("replica-1", "chess", 1, "abc")
    with pytest.raises(UnknownLeague):
        registry.replicas.acknowledgements("chess")


def test_a_replica_reports_the_version_of_each_alias(registry: Registry) -> None:
    registry.replicas.acknowledge("replica-1", LEAGUE, 2, "abc", None, {"champion": 2, "candidate": 3})
    (row,) = registry.replicas.acknowledgements(LEAGUE)
    assert row.aliases == {"champion": 2, "candidate": 3}


def test_any_acknowledgement_is_a_sign_of_life(registry: Registry) -> None:
    registered(registry, "another")
    for replica in ("replica-1", "replica-2"):
        registry.replicas.acknowledge(replica, LEAGUE, 1, "abc")
        backdate(registry, replica, timedelta(seconds=20))
    registry.replicas.acknowledge("replica-1", "another", 1, "abc")
    silences = {row.replica: row.silence for row in registry.replicas.acknowledgements(LEAGUE)}
    assert silences["replica-1"] < LIVENESS_TIMEOUT < silences["replica-2"]
