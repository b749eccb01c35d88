"""The change token of a league changes with its data, and not with that of other leagues; waiting for replicas."""

from collections import Counter
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.errors import AliasMoved, NotReady
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.processes import this_process
from league.registry.registry import Registry
from league.registry.replicas import PROCESS
from league.registry.storage.rows import AliasEvent, Portion, RunPoint
from tests.support.leagues.acknowledgements import acknowledge as acknowledge_league
from tests.support.leagues.acknowledgements import read_everything, silence
from tests.support.leagues.registries import LEAGUE, promote, publish, registered

CHANGES: list[Callable[[Registry], object]] = [
    lambda registry: publish(registry, "run/1"),
    lambda registry: registry.aliases.set(LEAGUE, "champion", 1, expected=ANY, **OPTIONS),
    lambda registry: registry.aliases.set(LEAGUE, "candidate", 1, expected=ANY, **OPTIONS),
    lambda registry: registry.versions.set_note(CheckpointRef(LEAGUE, 1), "a try", actor="test"),
    lambda registry: registry.traffic.set(LEAGUE, shadow=Portion(1, 0.5), **OPTIONS),
    lambda registry: acknowledge_league(registry, "replica-1", LEAGUE, 1, "0" * 64),
    lambda registry: acknowledge_league(registry, "replica-2", LEAGUE, 1, "0" * 64),
    lambda registry: registry.verdicts.open(LEAGUE, 1, "script:random", "s1", {}),
    lambda registry: registry.verdicts.close("s1", "reject", {}),
    lambda registry: registry.verdicts.void("s1", "by mistake"),
    lambda registry: registry.evaluations.submit(LEAGUE, {"kind": "tournament"}, actor="test", max_active=9),
    lambda registry: registry.evaluations.claim("runner", 1),
    lambda registry: registry.evaluations.heartbeat(1, "runner", {"what": "two", "played": 1, "of": 4}),
    lambda registry: registry.evaluations.finish(1, "runner", "done", result={}),
    lambda registry: registry.runs.begin(LEAGUE, "first", algorithm="ppo", settings={}, seed=0, target=9),
    lambda registry: registry.runs.record(LEAGUE, "first", RunPoint(LEAGUE, "first", 3, {"return": 0.5}, NOON)),
    lambda registry: registry.runs.end(LEAGUE, "first", "ended"),
    lambda registry: registry.snapshots.put(LEAGUE, {"summary": {}}, mark="a"),
]


NOON = datetime(2026, 3, 3, 12, tzinfo=UTC)


def test_each_change_changes_the_token_of_its_league_only(registry: Registry) -> None:
    registered(registry, "chess")
    tokens, other = [registry.changes.token(LEAGUE)], registry.changes.token("chess")
    for change in CHANGES:
        change(registry)
        tokens.append(registry.changes.token(LEAGUE))
        assert tokens[-1] not in tokens[:-1]
        assert registry.changes.token(LEAGUE) == tokens[-1]
    assert registry.changes.token("chess") == other


def test_the_token_has_the_current_activity(registry: Registry) -> None:
    for change in CHANGES[:-2]:
        change(registry)
    token = registry.changes.token(LEAGUE)
    assert (token.aliases, token.version, token.serving) == ({"champion": 1, "candidate": 1}, 1, {1: 2})
    assert (token.verdicts, token.evaluation, token.evaluations) == ({"void": 1}, 1, ())
    assert (token.run, [(run.id, run.state, run.steps) for run in token.runs]) == ("first", [("first", "running", 3)])
    number = registry.evaluations.submit(LEAGUE, {"kind": "nightly"}, actor="test", max_active=9).id
    registry.runs.end(LEAGUE, "first", "failed", "no reason")
    token = registry.changes.token(LEAGUE)
    assert [(row.id, row.state) for row in token.evaluations] == [(number, "queued")]
    assert (token.run, token.runs) == ("first", ())


@pytest.fixture
def served(registry: Registry) -> Registry:
    """Two versions, the second just promoted; two replicas serve the first."""
    registered(registry, LEAGUE, versions=2)
    promote(registry, 1)
    promote(registry, 2)
    for replica in ("replica-1", "replica-2"):
        acknowledge(registry, replica, 1)
    return registry


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


def test_a_replica_of_this_machine_is_not_awaited_when_its_process_has_ended(served: Registry) -> None:
    """No other replica has noticed it yet."""
    acknowledge(served, "replica-1", 2)
    machine, pid, _ = this_process().rsplit(":", 2)
    for replica, process in {"replica-1": this_process(), "replica-2": f"{machine}:{pid}:1"}.items():
        assert served.replicas.register(replica, {PROCESS: process})
    assert served.changes.wait_for_alias(newest(served), 60) == ["replica-1"]


def test_an_acknowledgement_of_an_earlier_event_does_not_count(served: Registry) -> None:
    """A replica that switched to version 2 and lost its connection before it said so is not at version 1 any more."""
    acknowledge(served, "replica-1", 1)
    read = newest(served).id
    promote(served, 1)
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


def test_waiting_without_a_server_fails(registry: Registry) -> None:
    registered(registry, LEAGUE, versions=1)
    promote(registry, 1)
    with pytest.raises(NotReady, match="is a server running"):
        registry.changes.wait_for_alias(newest(registry), 0)


def test_a_replica_that_serves_what_it_has_read_follows_each_change_of_any_league(registry: Registry) -> None:
    registered(registry, LEAGUE, versions=2)
    registered(registry, "another", versions=1)
    promote(registry, 1)
    read_everything(registry, "replica-1")
    promote(registry, 2)
    other = registry.aliases.set("another", "champion", 1, expected=None, actor="test", reason="test")
    for event, serves in ((newest(registry), "replica-1 serves version 1"), (other, "has not reported on this league")):
        with pytest.raises(NotReady, match=serves):
            registry.changes.wait_for_alias(event, 0)
    read_everything(registry, "replica-1")
    assert registry.changes.wait_for_alias(newest(registry), 0) == ["replica-1"]
    assert registry.changes.wait_for_alias(other, 0) == ["replica-1"]
    registry.replicas.register("replica-2", {})
    with pytest.raises(NotReady, match="replica-2 has not reported on this league"):
        registry.changes.wait_for_alias(other, 0)
    registry.replicas.remove("replica-2")
    assert registry.changes.wait_for_alias(other, 0) == ["replica-1"]


def test_a_replica_that_has_read_only_a_move_between_does_not_follow(registry: Registry) -> None:
    """The alias has moved away and back: the replica may serve the version in between."""
    registered(registry, LEAGUE, versions=2)
    promote(registry, 2)
    first = newest(registry)
    promote(registry, 1)
    read_everything(registry, "replica-1")
    promote(registry, 2)
    with pytest.raises(NotReady, match="replica-1 serves version 1"):
        registry.changes.wait_for_alias(first, 0)
    read_everything(registry, "replica-1")
    assert registry.changes.wait_for_alias(first, 0) == ["replica-1"]


def test_an_event_with_the_id_of_a_removed_one_is_awaited(registry: Registry) -> None:
    """SQLite uses the newest id again."""
    for name in ("another", "third"):
        registered(registry, name, versions=1)
    registry.aliases.set("another", "champion", 1, expected=None, actor="test", reason="test")
    read_everything(registry, "replica-1")
    registry.removal.remove_league("another", force=True)
    event = registry.aliases.set("third", "champion", 1, expected=None, actor="test", reason="test")
    with pytest.raises(NotReady, match="1 of 1 replicas"):
        registry.changes.wait_for_alias(event, 0)


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("promote"), st.integers(1, 3)),
            st.tuples(st.sampled_from(["read", "fail", "settle", "remove"]), st.integers(1, 3)),
        ),
        max_size=12,
    )
)
@settings(max_examples=15)
def test_counts_in_sql_agree_with_the_listed_acknowledgements(registry: Registry, steps: list[tuple[str, int]]) -> None:
    if not registry.versions.all(LEAGUE):
        registered(registry, LEAGUE, versions=3)
    for name in ("replica-1", "replica-2", "replica-3"):
        registry.replicas.remove(name)
    promote(registry, 1)
    for step, number in steps:
        name, event = f"replica-{number}", newest(registry)
        if step == "promote":
            promote(registry, number)
        elif step == "read":
            read_everything(registry, name)
        elif step == "fail":
            acknowledge(registry, name, number, "champion: it is broken")
        elif step == "remove":
            registry.replicas.remove(name)
        else:
            acknowledge_league(
                registry, name, LEAGUE, event.version, "0" * 64, None, {"champion": event.version}, event=event.id
            )
    event, listed = newest(registry), registry.replicas.acknowledgements(LEAGUE)
    late = [one.replica for one in listed if (one.event or 0) < event.id or one.aliases["champion"] != event.version]
    served = Counter(one.version for one in listed if one.version is not None)
    assert registry.changes.token(LEAGUE).serving == dict(sorted(served.items()))
    if listed and not late:
        assert registry.changes.wait_for_alias(event, 0) == [one.replica for one in listed]
        return
    with pytest.raises(NotReady) as caught:
        registry.changes.wait_for_alias(event, 0)
    assert all((f"{one.replica} " in str(caught.value)) == (one.replica in late) for one in listed)


def test_waiting_ends_when_the_last_replica_has_followed(served: Registry) -> None:
    sleep = sleep_with_events(
        lambda: acknowledge(served, "replica-1", 2),
        lambda: acknowledge(served, "replica-3", 1),
        lambda: acknowledge(served, "replica-3", 2),
        lambda: acknowledge(served, "replica-2", 2),
    )
    assert served.changes.wait_for_alias(newest(served), 60, sleep) == ["replica-1", "replica-2", "replica-3"]
    acknowledge(served, "replica-1", 1)
    with pytest.raises(AliasMoved, match="set to version 1"):
        served.changes.wait_for_alias(newest(served), 60, sleep_with_events(lambda: promote(served, 1)))


def test_a_silent_replica_is_awaited_and_named_unless_it_had_followed(served: Registry) -> None:
    """It may still serve the previous version: its database connection may be lost, or its process stopped."""
    acknowledge(served, "replica-1", 2)
    silence(served, "replica-2", timedelta(hours=1))
    with pytest.raises(NotReady, match="replica-2 has been silent for 3600 s; last known: serves version 1"):
        served.changes.wait_for_alias(newest(served), 0)
    acknowledge(served, "replica-2", 2)
    silence(served, "replica-2", timedelta(hours=1))
    assert served.changes.wait_for_alias(newest(served), 0) == ["replica-1", "replica-2"]


OPTIONS = {"actor": "test", "reason": "test"}
