"""Records are detached from their transaction, and immutable afterwards."""

from dataclasses import FrozenInstanceError, fields, replace
from datetime import UTC, datetime

import pytest
from sqlalchemy import inspect
from sqlalchemy.orm.exc import DetachedInstanceError

from league.registry.registry import Registry
from league.registry.storage.rows import HEARTBEAT_TIMEOUT, KeyRow, Record, RunRow
from tests.support.leagues.registries import LEAGUE, publish


@pytest.fixture
def records(registry: Registry) -> dict[type[Record], Record]:
    """A record that was read, and records that were created."""
    publish(registry, "run/1000")
    event = registry.aliases.set(LEAGUE, "champion", 1, expected=None, actor="ada", reason="test")
    run = registry.runs.begin(LEAGUE, "run", algorithm="ppo", settings={}, seed=1, target=9)
    key, _ = registry.keys.create("ci", ["read"])
    found = [registry.leagues.get(LEAGUE), event, run, key, registry.nightly_runs.open(LEAGUE, [1], 0.1)]
    return {type(record): record for record in found}


def test_records_are_immutable_after_their_transaction(records: dict[type[Record], Record], registry: Registry) -> None:
    for record in records.values():
        assert inspect(record).detached
        for name in (field.name for field in fields(record)):
            with pytest.raises(FrozenInstanceError, match=f"{name} of {type(record).__name__} cannot be set"):
                setattr(record, name, None)
    (key,) = registry.keys.all()
    assert key == records[KeyRow]
    assert key != replace(key, expires_at=datetime.now(UTC))
    assert registry.runs.get(LEAGUE, "run") == records[RunRow]


def test_the_record_of_a_run_is_read_only_where_it_is_needed(registry: Registry) -> None:
    registry.runs.begin(LEAGUE, "run", algorithm="ppo", settings={}, seed=1, target=9, record={"pins": {}})
    registry.runs.begin(LEAGUE, "other", algorithm="ppo", settings={}, seed=1, target=9)
    with pytest.raises(DetachedInstanceError):
        _ = registry.runs.get(LEAGUE, "run").record
    assert [(run.id, run.record) for run in registry.runs.stored(LEAGUE)] == [("run", {"pins": {}})]


def test_a_run_is_silent_without_heartbeats(records: dict[type[Record], Record]) -> None:
    run = records[RunRow]
    assert isinstance(run, RunRow)
    silent_since = datetime.now(UTC) - 2 * HEARTBEAT_TIMEOUT
    assert run.state == "running"
    assert replace(run, heartbeat_at=silent_since).state == "silent"
    assert replace(run, heartbeat_at=silent_since, reported_state="ended").state == "ended"
