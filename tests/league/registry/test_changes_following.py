"""Waiting for replicas to follow an alias."""

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import update

from league.errors import AliasMoved, NotReady
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.replicas import LIVENESS_TIMEOUT
from league.registry.storage.tables import AcknowledgementTable
from tests.support.leagues.registries import LEAGUE, registered


@pytest.fixture
def served(local: Registry) -> Registry:
    """Two versions, the second just promoted; two replicas serve the first."""
    registered(local, LEAGUE, versions=2)
    champion(local, 1)
    champion(local, 2)
    for replica in ("replica-1", "replica-2"):
        acknowledge(local, replica, 1)
    return local


def champion(registry: Registry, version: int) -> None:
    registry.aliases.set(LEAGUE, "champion", version, expected=ANY, actor="test", reason="test")


def acknowledge(registry: Registry, replica: str, version: int, fault: str | None = None) -> None:
    registry.replicas.acknowledge(replica, LEAGUE, version, "0" * 64, fault, {"champion": version})


def sleep_with_events(*events: Callable[[], Any]) -> Callable[[float], None]:
    """A `sleep` during which the next of `events` happens, as long as there is one."""
    left: Iterator[Callable[[], Any]] = iter(events)
    return lambda _: next(left, lambda: None)()


def test_waiting_ends_when_the_last_replica_has_followed(served: Registry) -> None:
    sleep = sleep_with_events(
        lambda: acknowledge(served, "replica-1", 2),
        lambda: acknowledge(served, "replica-3", 1),
        lambda: acknowledge(served, "replica-3", 2),
        lambda: acknowledge(served, "replica-2", 2),
    )
    assert served.changes.wait_for_alias(LEAGUE, "champion", 2, 60, sleep) == ["replica-1", "replica-2", "replica-3"]


def test_a_replica_that_does_not_follow_is_named_with_its_fault(served: Registry) -> None:
    acknowledge(served, "replica-1", 2)
    acknowledge(served, "replica-2", 1, "champion: shared.onnx was changed")
    registered(served, "another")
    served.replicas.acknowledge("replica-3", "another", 1, "0" * 64)
    with pytest.raises(NotReady) as caught:
        served.changes.wait_for_alias(LEAGUE, "champion", 2, 0)
    assert "2 of 3 replicas" in str(caught.value)
    assert "replica-2 serves version 1 (champion: shared.onnx was changed)" in str(caught.value)
    assert "replica-3 has not reported on this league" in str(caught.value)
    assert "replica-1" not in str(caught.value)


def test_dead_replicas_are_not_awaited(served: Registry) -> None:
    acknowledge(served, "replica-1", 2)

    def die() -> None:
        with served.database.write() as session:
            at = datetime.now(UTC) - LIVENESS_TIMEOUT - timedelta(seconds=1)
            session.execute(update(AcknowledgementTable).filter_by(replica="replica-2").values(seen_at=at))

    assert served.changes.wait_for_alias(LEAGUE, "champion", 2, 60, sleep_with_events(die)) == ["replica-1"]


def test_other_aliases_are_awaited_separately(served: Registry) -> None:
    served.aliases.set(LEAGUE, "candidate", 1, expected=None, actor="test", reason="test")
    with pytest.raises(NotReady, match="2 of 2"):
        served.changes.wait_for_alias(LEAGUE, "candidate", 1, 0)
    for replica in ("replica-1", "replica-2"):
        served.replicas.acknowledge(replica, LEAGUE, 2, "0" * 64, None, {"champion": 2, "candidate": 1})
    assert len(served.changes.wait_for_alias(LEAGUE, "candidate", 1, 0)) == 2


def test_waiting_ends_if_the_alias_moves_again(served: Registry) -> None:
    with pytest.raises(AliasMoved, match="set to version 1"):
        served.changes.wait_for_alias(LEAGUE, "champion", 2, 60, sleep_with_events(lambda: champion(served, 1)))


def test_waiting_without_a_server_fails(local: Registry) -> None:
    registered(local, LEAGUE, versions=1)
    champion(local, 1)
    with pytest.raises(NotReady, match="is a server running"):
        local.changes.wait_for_alias(LEAGUE, "champion", 1, 0)
