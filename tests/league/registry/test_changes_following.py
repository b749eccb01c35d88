"""Waiting for replicas to follow an alias."""

from collections import Counter
from collections.abc import Callable, Iterator
from datetime import timedelta
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import update

from league.errors import AliasMoved, NotReady
from league.registry.aliases import ANY
from league.registry.processes import this_process
from league.registry.registry import Registry
from league.registry.replicas import PROCESS
from league.registry.storage.database import clock
from league.registry.storage.rows import AliasEvent
from league.registry.storage.tables import ReplicaTable
from tests.support.leagues.acknowledgements import acknowledge as acknowledge_league
from tests.support.leagues.acknowledgements import read_everything
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
    """Acknowledge a version after reading the newest event."""
    aliases = {"champion": version}
    acknowledge_league(registry, replica, LEAGUE, version, "0" * 64, fault, aliases, event=newest(registry).id)


def newest(registry: Registry, alias: str = "champion") -> AliasEvent:
    return registry.aliases.history(LEAGUE, alias)[0]


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
    assert served.changes.wait_for_alias(newest(served), 60, sleep) == ["replica-1", "replica-2", "replica-3"]


def test_a_replica_that_does_not_follow_is_named_with_its_fault(served: Registry) -> None:
    acknowledge(served, "replica-1", 2)
    acknowledge(served, "replica-2", 1, "champion: shared.onnx was changed")
    registered(served, "another")
    acknowledge_league(served, "replica-3", "another", 1, "0" * 64)
    with pytest.raises(NotReady) as caught:
        served.changes.wait_for_alias(newest(served), 0)
    assert "2 of 3 replicas" in str(caught.value)
    assert "replica-2 serves version 1 (champion: shared.onnx was changed)" in str(caught.value)
    assert "replica-3 has not reported on this league" in str(caught.value)
    assert "replica-1" not in str(caught.value)


def silence(registry: Registry, replica: str, seconds: float) -> None:
    """Let the last report of a replica be older."""
    with registry.database.write() as session:
        seen_at = clock(session) - timedelta(seconds=seconds)
        session.execute(update(ReplicaTable).filter_by(replica=replica).values(seen_at=seen_at))


def test_a_silent_replica_is_awaited_and_named(served: Registry) -> None:
    """It may still serve the previous version: its database connection may be lost, or its process stopped."""
    acknowledge(served, "replica-1", 2)
    silence(served, "replica-2", 3600)
    with pytest.raises(NotReady, match="replica-2 has been silent for 3600 s; last known: serves version 1"):
        served.changes.wait_for_alias(newest(served), 0)


def test_a_replica_of_this_machine_is_not_awaited_when_its_process_has_ended(served: Registry) -> None:
    """No other replica has noticed it yet."""
    acknowledge(served, "replica-1", 2)
    machine, pid, _ = this_process().rsplit(":", 2)
    for replica, process in {"replica-1": this_process(), "replica-2": f"{machine}:{pid}:1"}.items():
        assert served.replicas.register(replica, {PROCESS: process})
    assert served.changes.wait_for_alias(newest(served), 60) == ["replica-1"]


def test_a_replica_that_followed_before_it_fell_silent_is_no_obstacle(served: Registry) -> None:
    for replica in ("replica-1", "replica-2"):
        acknowledge(served, replica, 2)
    silence(served, "replica-2", 3600)
    assert served.changes.wait_for_alias(newest(served), 0) == ["replica-1", "replica-2"]


def test_a_replica_is_awaited_from_its_registration_until_it_is_removed(served: Registry) -> None:
    for replica in ("replica-1", "replica-2"):
        acknowledge(served, replica, 2)
    served.replicas.register("replica-3", {})
    with pytest.raises(NotReady, match="replica-3 has not reported on this league"):
        served.changes.wait_for_alias(newest(served), 0)
    served.replicas.remove("replica-3")
    assert len(served.changes.wait_for_alias(newest(served), 0)) == 2


def test_an_acknowledgement_of_an_earlier_event_does_not_count(served: Registry) -> None:
    """A replica that switched to version 2 and lost its connection before it said so is not at version 1 any more."""
    acknowledge(served, "replica-1", 1)
    read = newest(served).id
    champion(served, 1)
    assert newest(served).id > read
    acknowledge(served, "replica-2", 1)
    with pytest.raises(NotReady, match="1 of 2 replicas have not confirmed it: replica-1 serves version 1"):
        served.changes.wait_for_alias(newest(served), 0)


def test_other_aliases_are_awaited_separately(served: Registry) -> None:
    served.aliases.set(LEAGUE, "candidate", 1, expected=None, actor="test", reason="test")
    with pytest.raises(NotReady, match="2 of 2"):
        served.changes.wait_for_alias(newest(served, "candidate"), 0)
    for replica in ("replica-1", "replica-2"):
        aliases, event = {"champion": 2, "candidate": 1}, newest(served, "candidate").id
        acknowledge_league(served, replica, LEAGUE, 2, "0" * 64, None, aliases, event=event)
    assert len(served.changes.wait_for_alias(newest(served, "candidate"), 0)) == 2


def test_waiting_ends_if_the_alias_moves_again(served: Registry) -> None:
    with pytest.raises(AliasMoved, match="set to version 1"):
        served.changes.wait_for_alias(newest(served), 60, sleep_with_events(lambda: champion(served, 1)))


def test_waiting_without_a_server_fails(local: Registry) -> None:
    registered(local, LEAGUE, versions=1)
    champion(local, 1)
    with pytest.raises(NotReady, match="is a server running"):
        local.changes.wait_for_alias(newest(local), 0)


def test_a_replica_that_serves_what_it_has_read_follows_each_change_of_any_league(local: Registry) -> None:
    registered(local, LEAGUE, versions=2)
    registered(local, "another", versions=1)
    champion(local, 1)
    read_everything(local, "replica-1")
    champion(local, 2)
    other = local.aliases.set("another", "champion", 1, expected=None, actor="test", reason="test")
    for event, serves in ((newest(local), "replica-1 serves version 1"), (other, "has not reported on this league")):
        with pytest.raises(NotReady, match=serves):
            local.changes.wait_for_alias(event, 0)
    read_everything(local, "replica-1")
    assert local.changes.wait_for_alias(newest(local), 0) == ["replica-1"]
    assert local.changes.wait_for_alias(other, 0) == ["replica-1"]
    local.replicas.register("replica-2", {})
    with pytest.raises(NotReady, match="replica-2 has not reported on this league"):
        local.changes.wait_for_alias(other, 0)


def test_a_replica_that_has_read_only_a_move_between_does_not_follow(local: Registry) -> None:
    """The alias has moved away and back: the replica may serve the version in between."""
    registered(local, LEAGUE, versions=2)
    champion(local, 2)
    first = newest(local)
    champion(local, 1)
    read_everything(local, "replica-1")
    champion(local, 2)
    with pytest.raises(NotReady, match="replica-1 serves version 1"):
        local.changes.wait_for_alias(first, 0)
    read_everything(local, "replica-1")
    assert local.changes.wait_for_alias(first, 0) == ["replica-1"]


def test_an_event_with_the_id_of_a_removed_one_is_awaited(local: Registry) -> None:
    """SQLite uses the newest id again."""
    for name in ("another", "third"):
        registered(local, name, versions=1)
    local.aliases.set("another", "champion", 1, expected=None, actor="test", reason="test")
    read_everything(local, "replica-1")
    local.removal.remove_league("another", force=True)
    event = local.aliases.set("third", "champion", 1, expected=None, actor="test", reason="test")
    with pytest.raises(NotReady, match="1 of 1 replicas"):
        local.changes.wait_for_alias(event, 0)


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("promote"), st.integers(1, 3)),
            st.tuples(st.sampled_from(["read", "fail", "settle", "remove"]), st.integers(1, 3)),
        ),
        max_size=12,
    )
)
@settings(max_examples=30)
def test_counts_in_sql_agree_with_the_listed_acknowledgements(local: Registry, steps: list[tuple[str, int]]) -> None:
    if not local.versions.all(LEAGUE):
        registered(local, LEAGUE, versions=3)
    for name in ("replica-1", "replica-2", "replica-3"):
        local.replicas.remove(name)
    champion(local, 1)
    for step, number in steps:
        name, event = f"replica-{number}", newest(local)
        if step == "promote":
            champion(local, number)
        elif step == "read":
            read_everything(local, name)
        elif step == "fail":
            acknowledge(local, name, number, "champion: it is broken")
        elif step == "remove":
            local.replicas.remove(name)
        else:
            acknowledge_league(
                local, name, LEAGUE, event.version, "0" * 64, None, {"champion": event.version}, event=event.id
            )
    event, listed = newest(local), local.replicas.acknowledgements(LEAGUE)
    late = [one.replica for one in listed if (one.event or 0) < event.id or one.aliases["champion"] != event.version]
    served = Counter(one.version for one in listed if one.version is not None)
    assert local.changes.token(LEAGUE).serving == dict(sorted(served.items()))
    if listed and not late:
        assert local.changes.wait_for_alias(event, 0) == [one.replica for one in listed]
        return
    with pytest.raises(NotReady) as caught:
        local.changes.wait_for_alias(event, 0)
    assert all((f"{one.replica} " in str(caught.value)) == (one.replica in late) for one in listed)
