"""Waiting for replicas to follow an alias."""

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import update

from league.errors import AliasMoved, NotReady
from league.registry.aliases import ANY
from league.registry.following import LIVES, await_followers
from league.registry.registry import Registry
from league.registry.tables import Acknowledgement
from tests.league.registry.examples import LEAGUE, registered


@pytest.fixture
def served(local: Registry) -> Registry:
    """Two versions, the second of which is the champion since just now; two replicas serve the first."""
    registered(local, LEAGUE, versions=2)
    champion(local, 1)
    champion(local, 2)
    for replica in ("replica-1", "replica-2"):
        says(local, replica, 1)
    return local


def champion(registry: Registry, version: int) -> None:
    registry.set_alias(LEAGUE, "champion", version, expected=ANY, actor="test", reason="test")


def says(registry: Registry, replica: str, version: int, fault: str | None = None) -> None:
    registry.acknowledge(replica, LEAGUE, version, "0" * 64, fault, {"champion": version})


def meanwhile(*events: Callable[[], Any]) -> Callable[[float], None]:
    """A `sleep` during each of which one of `events` happens, and in the end nothing more."""
    left: Iterator[Callable[[], Any]] = iter(events)
    return lambda _: next(left, lambda: None)()


def test_it_ends_when_the_last_has_followed(served: Registry) -> None:
    sleep = meanwhile(
        lambda: says(served, "replica-1", 2),
        lambda: says(served, "replica-3", 1),
        lambda: says(served, "replica-3", 2),
        lambda: says(served, "replica-2", 2),
    )
    assert await_followers(served, LEAGUE, "champion", 2, 60, sleep) == ["replica-1", "replica-2", "replica-3"]


def test_who_does_not_follow_is_named_with_its_fault(served: Registry) -> None:
    says(served, "replica-1", 2)
    says(served, "replica-2", 1, "champion: shared.onnx was changed")
    registered(served, "another")
    served.acknowledge("replica-3", "another", 1, "0" * 64)
    with pytest.raises(NotReady) as caught:
        await_followers(served, LEAGUE, "champion", 2, 0)
    assert "2 of 3 replicas" in str(caught.value)
    assert "replica-2 serves version 1 (champion: shared.onnx was changed)" in str(caught.value)
    assert "replica-3 has said nothing of this league" in str(caught.value)
    assert "replica-1" not in str(caught.value)


def test_the_dead_are_not_waited_for(served: Registry) -> None:
    says(served, "replica-1", 2)

    def die() -> None:
        with served.database.write() as session:
            at = datetime.now(UTC) - LIVES - timedelta(seconds=1)
            session.execute(update(Acknowledgement).filter_by(replica="replica-2").values(seen_at=at))

    assert await_followers(served, LEAGUE, "champion", 2, 60, meanwhile(die)) == ["replica-1"]


def test_another_alias_is_followed_for_itself(served: Registry) -> None:
    served.set_alias(LEAGUE, "candidate", 1, expected=None, actor="test", reason="test")
    with pytest.raises(NotReady, match="2 of 2"):
        await_followers(served, LEAGUE, "candidate", 1, 0)
    for replica in ("replica-1", "replica-2"):
        served.acknowledge(replica, LEAGUE, 2, "0" * 64, None, {"champion": 2, "candidate": 1})
    assert len(await_followers(served, LEAGUE, "candidate", 1, 0)) == 2


def test_an_alias_that_moves_on_is_not_waited_for(served: Registry) -> None:
    with pytest.raises(AliasMoved, match="moved on to version 1"):
        await_followers(served, LEAGUE, "champion", 2, 60, meanwhile(lambda: champion(served, 1)))


def test_without_a_server_there_is_nobody_to_wait_for(local: Registry) -> None:
    registered(local, LEAGUE, versions=1)
    champion(local, 1)
    with pytest.raises(NotReady, match="is a server running"):
        await_followers(local, LEAGUE, "champion", 1, 0)
