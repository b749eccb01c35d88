from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import update

from league.errors import UnknownLeague
from league.registry.registry import Registry
from league.registry.tables import Acknowledgement
from tests.league.registry.examples import LEAGUE, registered


def age(registry: Registry, replica: str, by: timedelta) -> None:
    with registry.database.write() as session:
        statement = update(Acknowledgement).filter_by(replica=replica)
        session.execute(statement.values(seen_at=datetime.now(UTC) - by))


def test_a_replica_says_what_it_serves_and_says_it_again(registry: Registry) -> None:
    registry.acknowledge("replica-1", LEAGUE, None, None, fault="tictactoe@1: manifest.json is missing")
    registry.acknowledge("replica-2", LEAGUE, 1, "abc")
    registry.acknowledge("replica-1", LEAGUE, 2, "def")
    found = registry.acknowledgements(LEAGUE)
    assert [(row.replica, row.version, row.sha256, row.fault) for row in found] == [
        ("replica-1", 2, "def", None),
        ("replica-2", 1, "abc", None),
    ]
    assert all(datetime.now(UTC) - row.seen_at < timedelta(minutes=1) for row in found)


def test_faults_are_kept(registry: Registry) -> None:
    registry.acknowledge("replica-1", LEAGUE, 1, "abc", fault="tictactoe@2: shared.onnx was changed")
    (row,) = registry.acknowledgements(LEAGUE)
    assert (row.version, row.fault) == (1, "tictactoe@2: shared.onnx was changed")


def test_a_silent_replica_is_left_out_and_later_forgotten(registry: Registry) -> None:
    registry.acknowledge("silent", LEAGUE, 1, "abc")
    age(registry, "silent", timedelta(seconds=20))
    registry.acknowledge("alive", LEAGUE, 1, "abc")
    assert [row.replica for row in registry.acknowledgements(LEAGUE)] == ["alive"]
    assert len(registry.acknowledgements(LEAGUE, since=timedelta(minutes=1))) == 2
    age(registry, "silent", timedelta(days=2))
    registry.acknowledge("alive", LEAGUE, 1, "abc")
    assert len(registry.acknowledgements(LEAGUE, since=timedelta(days=9))) == 1


def test_a_replica_that_stops_is_forgotten(registry: Registry) -> None:
    registered(registry, "another")
    registry.acknowledge("replica-1", LEAGUE, 1, "abc")
    registry.acknowledge("replica-1", "another", 1, "abc")
    registry.acknowledge("replica-2", LEAGUE, 1, "abc")
    registry.forget("replica-1")
    assert [row.replica for row in registry.acknowledgements(LEAGUE)] == ["replica-2"]
    assert registry.acknowledgements("another") == []


def test_an_unknown_league_is_refused(registry: Registry) -> None:
    with pytest.raises(UnknownLeague):
        registry.acknowledge("replica-1", "chess", 1, "abc")
    with pytest.raises(UnknownLeague):
        registry.acknowledgements("chess")


def test_a_replica_says_which_alias_answers_from_what(registry: Registry) -> None:
    registry.acknowledge("replica-1", LEAGUE, 2, "abc", None, {"champion": 2, "candidate": 3})
    (row,) = registry.acknowledgements(LEAGUE)
    assert row.aliases == {"champion": 2, "candidate": 3}


def test_replicas_live_as_long_as_they_say_anything(registry: Registry) -> None:
    registered(registry, "another")
    registry.acknowledge("replica-2", LEAGUE, 1, "abc")
    registry.acknowledge("replica-1", "another", 1, "abc")
    registry.acknowledge("replica-1", LEAGUE, 1, "abc")
    registry.acknowledge("replica-3", LEAGUE, 1, "abc")
    age(registry, "replica-3", timedelta(seconds=20))
    assert registry.replicas() == ["replica-1", "replica-2"]
