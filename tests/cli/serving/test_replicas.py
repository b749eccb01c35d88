from datetime import timedelta

import pytest
from sqlalchemy import update

from league.registry.registry import Registry
from league.registry.replicas import URL
from league.registry.storage.database import clock
from league.registry.storage.tables import ReplicaTable
from tests.support.command import League
from tests.support.databases import on_both_databases

pytestmark = on_both_databases


@pytest.fixture
def silent(registry: Registry) -> str:
    """A replica that reports, and one that has not done so for an hour."""
    registry.replicas.register("alive", {URL: "http://127.0.0.1:30001"})
    registry.replicas.register("silent", {})
    with registry.database.write() as session:
        seen_at = clock(session) - timedelta(hours=1)
        session.execute(update(ReplicaTable).filter_by(replica="silent").values(seen_at=seen_at))
    return "silent"


@pytest.mark.usefixtures("silent")
def test_replicas_are_listed_with_their_state(league: League) -> None:
    out = league("replicas").out
    assert [line.split()[0] for line in out.splitlines() if "reports" in line] == ["alive"]
    assert [line.split()[0] for line in out.splitlines() if "silent" in line] == ["silent"]
    document = league("replicas", "--json").json
    assert [(each["replica"], each["silent"]) for each in document["replicas"]] == [("alive", False), ("silent", True)]
    assert [each["url"] for each in document["replicas"]] == ["http://127.0.0.1:30001", None]
    assert "http://127.0.0.1:30001" in out
    assert document["replicas"][1]["silent_seconds"] == pytest.approx(3600, abs=60)


def test_a_silent_replica_can_be_removed(league: League, registry: Registry, silent: str) -> None:
    assert league("replicas", "--remove", silent).out == "Removed replica silent.\n"
    assert [each.replica for each in registry.replicas.registered()] == ["alive"]


@pytest.mark.usefixtures("silent")
@pytest.mark.parametrize(
    ("replica", "message"), [("alive", "stop it instead"), ("other", "no replica 'other'; known: alive, silent")]
)
def test_others_cannot_be_removed(league: League, registry: Registry, replica: str, message: str) -> None:
    result = league("replicas", "--remove", replica)
    assert result.code != 0
    assert message in result.err
    assert len(registry.replicas.registered()) == 2
