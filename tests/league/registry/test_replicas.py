from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import update

from league.errors import UnknownLeague
from league.registry.registry import Registry
from league.registry.storage.tables import AcknowledgementTable
from tests.support.leagues.registries import LEAGUE, registered


def backdate(registry: Registry, replica: str, by: timedelta) -> None:
    with registry.database.write() as session:
        statement = update(AcknowledgementTable).filter_by(replica=replica)
        session.execute(statement.values(seen_at=datetime.now(UTC) - by))


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


def test_a_silent_replica_is_omitted_and_later_deleted(registry: Registry) -> None:
    registry.replicas.acknowledge("silent", LEAGUE, 1, "abc")
    backdate(registry, "silent", timedelta(seconds=20))
    registry.replicas.acknowledge("alive", LEAGUE, 1, "abc")
    assert [row.replica for row in registry.replicas.acknowledgements(LEAGUE)] == ["alive"]
    assert len(registry.replicas.acknowledgements(LEAGUE, since=timedelta(minutes=1))) == 2
    backdate(registry, "silent", timedelta(days=2))
    registry.replicas.acknowledge("alive", LEAGUE, 1, "abc")
    assert len(registry.replicas.acknowledgements(LEAGUE, since=timedelta(days=9))) == 1


def test_a_stopped_replica_is_deleted(registry: Registry) -> None:
    registered(registry, "another")
    registry.replicas.acknowledge("replica-1", LEAGUE, 1, "abc")
    registry.replicas.acknowledge("replica-1", "another", 1, "abc")
    registry.replicas.acknowledge("replica-2", LEAGUE, 1, "abc")
    registry.replicas.remove("replica-1")
    assert [row.replica for row in registry.replicas.acknowledgements(LEAGUE)] == ["replica-2"]
    assert registry.replicas.acknowledgements("another") == []


def test_an_unknown_league_is_rejected(registry: Registry) -> None:
    with pytest.raises(UnknownLeague):
        registry.replicas.acknowledge("replica-1", "chess", 1, "abc")
    with pytest.raises(UnknownLeague):
        registry.replicas.acknowledgements("chess")


def test_a_replica_reports_the_version_of_each_alias(registry: Registry) -> None:
    registry.replicas.acknowledge("replica-1", LEAGUE, 2, "abc", None, {"champion": 2, "candidate": 3})
    (row,) = registry.replicas.acknowledgements(LEAGUE)
    assert row.aliases == {"champion": 2, "candidate": 3}


def test_any_acknowledgement_keeps_a_replica_alive(registry: Registry) -> None:
    registered(registry, "another")
    registry.replicas.acknowledge("replica-2", LEAGUE, 1, "abc")
    registry.replicas.acknowledge("replica-1", "another", 1, "abc")
    registry.replicas.acknowledge("replica-1", LEAGUE, 1, "abc")
    registry.replicas.acknowledge("replica-3", LEAGUE, 1, "abc")
    backdate(registry, "replica-3", timedelta(seconds=20))
    assert registry.replicas.live() == ["replica-1", "replica-2"]
