from datetime import datetime, timedelta
from types import SimpleNamespace

import pytest
from sqlalchemy import select

from league.registry import replicas
from league.registry.processes import this_process
from league.registry.registry import Registry
from league.registry.replicas import LIVENESS_TIMEOUT, PROCESS
from league.registry.storage import database
from league.registry.storage.database import clock
from league.registry.storage.rows import ReadPosition
from league.registry.storage.tables import ReplicaTable
from tests.support.databases import on_both_databases
from tests.support.leagues.acknowledgements import acknowledge, silence
from tests.support.leagues.registries import LEAGUE, registered


def test_a_silent_replica_is_listed(registry: Registry) -> None:
    acknowledge(registry, "silent", LEAGUE, 1, "abc")
    silence(registry, "silent", timedelta(hours=23))
    registry.replicas.register("alive", {})
    silent = {row.replica: row.silence for row in registry.replicas.acknowledgements(LEAGUE)}
    assert silent["alive"] < timedelta(minutes=1) < timedelta(hours=22) < silent["silent"]
    assert [row.replica for row in registry.replicas.silent()] == ["silent"]
    assert registry.replicas.counts() == (2, 1, 0)
    assert [row.replica for row in registry.replicas.registered()] == ["alive", "silent"]


def test_replicas_whose_processes_have_ended_are_removed_on_their_machine(registry: Registry) -> None:
    machine, pid, _ = this_process().rsplit(":", 2)
    descriptions = {
        "alive": {PROCESS: this_process()},
        "ended": {PROCESS: f"{machine}:{pid}:1"},
        "elsewhere": {PROCESS: f"another:{pid}:1"},
    }
    for replica, description in descriptions.items():
        registry.replicas.register(replica, description)
    registry.replicas.remove_ended()
    assert {row.replica for row in registry.replicas.registered()} == descriptions.keys() - {"ended"}


def test_replicas_that_are_being_stopped_are_counted_until_they_end(registry: Registry) -> None:
    for name in ("one", "two"):
        registry.replicas.register(name, {"machine": "here"})
    registry.replicas.register("one", {"machine": "here"}, is_draining=True)
    assert registry.replicas.counts() == (2, 0, 1)
    registry.replicas.remove("one")
    assert registry.replicas.counts() == (1, 0, 0)


def test_leagues_that_differ_have_a_row_until_they_are_settled(registry: Registry) -> None:
    registered(registry, "another")
    for league in (LEAGUE, "another"):
        acknowledge(registry, "replica-1", league, 1, "abc", "it is broken")
    faults = {league: registry.replicas.acknowledgements(league)[0].fault for league in (LEAGUE, "another")}
    assert faults == {LEAGUE: "it is broken", "another": "it is broken"}
    registry.replicas.acknowledge("replica-1", ReadPosition(0, 0, 0), {}, [LEAGUE])
    assert [registry.replicas.acknowledgements(league)[0].fault for league in faults] == [None, "it is broken"]
    registry.replicas.acknowledge("replica-1", ReadPosition(0, 0, 0), {})
    assert [registry.replicas.acknowledgements(league)[0].fault for league in faults] == [None, None]


@on_both_databases
@pytest.mark.parametrize("hours", [-1, 25])
def test_times_are_those_of_the_database(registry: Registry, monkeypatch: pytest.MonkeyPatch, hours: int) -> None:
    """A replica whose clock is wrong is seen alive, and removes nobody."""
    if registry.database.engine.dialect.name == "sqlite":
        pytest.skip("with SQLite, the clock of the machine is that of the database")
    registry.replicas.register("replica-1", {})
    clock_of_replica = SimpleNamespace(now=lambda zone: datetime.now(zone) + timedelta(hours=hours))
    for module in (database, replicas):
        monkeypatch.setattr(module, "datetime", clock_of_replica, raising=False)
    acknowledge(registry, "replica-2", LEAGUE, 1, "abc")
    registry.replicas.register("replica-2", {})
    monkeypatch.undo()
    rows = registry.replicas.acknowledgements(LEAGUE)
    assert [row.replica for row in rows] == ["replica-1", "replica-2"]
    assert all(abs(row.silence) < LIVENESS_TIMEOUT for row in rows)


def test_any_acknowledgement_is_a_sign_of_life(registry: Registry) -> None:
    registered(registry, "another")
    for replica in ("replica-1", "replica-2"):
        acknowledge(registry, replica, LEAGUE, 1, "abc")
        silence(registry, replica, timedelta(seconds=20))
    acknowledge(registry, "replica-1", "another", 1, "abc")
    silences = {row.replica: row.silence for row in registry.replicas.acknowledgements(LEAGUE)}
    assert silences["replica-1"] < LIVENESS_TIMEOUT < silences["replica-2"]


@on_both_databases
def test_a_replica_reports_its_versions_repeatedly(registry: Registry) -> None:
    acknowledge(registry, "replica-1", LEAGUE, None, None, fault="tictactoe@1: manifest.json is missing")
    acknowledge(registry, "replica-2", LEAGUE, 1, "abc", "tictactoe@2: shared.onnx was changed")
    acknowledge(registry, "replica-1", LEAGUE, 2, "def", None, {"champion": 2, "candidate": 3})
    rows = registry.replicas.acknowledgements(LEAGUE)
    assert [(row.replica, row.version, row.sha256, row.fault, row.aliases) for row in rows] == [
        ("replica-1", 2, "def", None, {"champion": 2, "candidate": 3}),
        ("replica-2", 1, "abc", "tictactoe@2: shared.onnx was changed", {}),
    ]
    with registry.database.read() as session:
        assert all(clock(session) - row.seen_at < timedelta(minutes=1) for row in rows)


def test_only_a_registered_replica_acknowledges(registry: Registry) -> None:
    """Another replica may take one for dead that is not: it registers again, and acknowledges everything."""
    position = ReadPosition(7, 7, 0)
    assert not registry.replicas.acknowledge("replica-1", position, {}, ())
    assert not registry.replicas.register("replica-1", {"machine": "here"})
    assert registry.replicas.register("replica-1", {"machine": "here"})
    (row,) = registry.replicas.acknowledgements(LEAGUE)
    assert (row.replica, row.version, row.aliases, row.event) == ("replica-1", None, {}, None)
    assert registry.replicas.acknowledge("replica-1", position, {}, ())
    (replica,) = registry.replicas.registered()
    assert replica.process == {"machine": "here"}
    with registry.database.read() as session:
        (stored,) = session.scalars(select(ReplicaTable))
        assert (stored.changes, stored.event, stored.traffic) == (7, 7, 0)
    registered(registry, "another")
    for league in (LEAGUE, "another"):
        acknowledge(registry, "replica-1", league, 1, "abc", event=7)
    registry.replicas.remove("replica-1")
    assert not registry.replicas.acknowledge("replica-1", position, {})
    assert registry.replicas.acknowledgements(LEAGUE) == registry.replicas.acknowledgements("another") == []
    assert not registry.replicas.register("replica-1", {"machine": "here"})
    (row,) = registry.replicas.acknowledgements(LEAGUE)
    assert (row.replica, row.version, row.event) == ("replica-1", None, None)
