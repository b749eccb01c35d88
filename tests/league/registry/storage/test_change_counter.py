"""Changes that replicas follow are counted, in the order of their commits. A repeated call is applied once."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import update

from league.config.league import LeagueConfig
from league.errors import AliasMoved, KeyReused, StorageError
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage import change_counter
from league.registry.storage.database import before
from league.registry.storage.idempotency import KEPT, IdempotentCall
from league.registry.storage.rows import AliasEvent, ChangeCounts, Portion
from league.registry.storage.tables import IdempotentCallTable
from tests.support.databases import on_both_databases
from tests.support.leagues.registries import LEAGUE, config, interface, promote, publish, registered

pytestmark = on_both_databases


def register(registry: Registry, play: dict[str, object]) -> None:
    """Register the league again with these settings of matches."""
    league = LeagueConfig.from_mapping(config().model_dump(by_alias=True) | {"play": play})
    registry.leagues.register(league, interface())


@pytest.fixture
def two_versions(registry: Registry) -> Registry:
    return registered(registry, LEAGUE, versions=2)


def test_what_replicas_follow_is_counted_and_nothing_else(two_versions: Registry) -> None:
    registry, options = two_versions, {"actor": "test", "reason": "test"}
    changes: list[tuple[Callable[[], object], tuple[int, ...]]] = [
        (lambda: promote(registry, 1), (1, 0, 0, 1)),
        (lambda: promote(registry, 1), (1, 0, 0, 1)),
        (lambda: promote(registry, 2), (2, 0, 0, 1)),
        (lambda: registry.aliases.rollback(LEAGUE, **options), (3, 0, 0, 1)),
        (lambda: registry.traffic.set(LEAGUE, canary=Portion(2, 0.5), **options), (3, 1, 0, 1)),
        (lambda: registry.traffic.set(LEAGUE, canary=Portion(2, 0.5), **options), (3, 1, 0, 1)),
        (lambda: registry.keys.create("bot", ["act"]), (3, 1, 1, 1)),
        (lambda: registry.keys.revoke("bot"), (3, 1, 2, 1)),
        (lambda: registry.keys.revoke("bot"), (3, 1, 2, 1)),
        (lambda: registered(registry, "another"), (3, 1, 2, 2)),
        (lambda: register(registry, {"opening_plies": 2}), (3, 1, 2, 2)),
        (lambda: register(registry, {"actions": "greedy"}), (3, 1, 2, 2)),
        (lambda: register(registry, {"actions": "sampled"}), (3, 1, 2, 3)),
        (lambda: register(registry, {}), (3, 1, 2, 4)),
        (lambda: registry.removal.remove_version(CheckpointRef(LEAGUE, 2), force=True), (4, 2, 2, 5)),
        (lambda: registry.removal.remove_league(LEAGUE, force=True), (5, 3, 2, 6)),
    ]
    with registry.database.write() as session:
        change_counter.count(session, "aliases")
        session.rollback()
    assert registry.changes.counts() == (0, 0, 0, 1)
    for change, expected in changes:
        change()
        assert registry.changes.counts() == expected


def test_changes_of_different_leagues_are_committed_one_after_the_other(two_versions: Registry) -> None:
    """A replica that has read the event of the later one has read the earlier one, too."""
    registered(two_versions, "another", versions=1)
    with two_versions.database.write() as session:
        change_counter.count(session, "aliases")
        with pytest.raises(StorageError), before(time.monotonic() + 0.2):
            promote(two_versions, 1, "another")
    promote(two_versions, 1, "another")
    assert two_versions.changes.counts() == ChangeCounts(2, 0, 0, 2)


@pytest.fixture
def call(registry: Registry) -> IdempotentCall:
    """A call on a league whose champion was version 1, then 2, then 3."""
    for number in (1, 2, 3):
        publish(registry, f"run/{number}")
        registry.aliases.set(LEAGUE, "champion", number, expected=ANY, actor="test", reason="test")
    key, _ = registry.keys.create("bot", ["promote"])
    return IdempotentCall(owner=key.id, key="first", digest="0" * 64)


def roll_back(registry: Registry, call: IdempotentCall) -> AliasEvent:
    return registry.aliases.rollback(LEAGUE, actor="bot", reason="test", call=call)


def test_a_failed_call_can_be_retried(registry: Registry, call: IdempotentCall) -> None:
    def move() -> AliasEvent:
        return registry.aliases.set(LEAGUE, "champion", 1, expected=2, actor="bot", reason="test", call=call)

    with pytest.raises(AliasMoved):
        move()
    registry.aliases.rollback(LEAGUE, actor="test", reason="test")
    assert move().version == 1


def test_concurrent_calls_are_applied_once(registry: Registry, call: IdempotentCall) -> None:
    with ThreadPoolExecutor(8) as pool:
        events = list(pool.map(lambda _: roll_back(registry, call), range(8)))
    assert len({event.id for event in events}) == 1
    assert registry.aliases.current(LEAGUE) == {"champion": 2}


def test_a_repeated_call_gets_the_same_answer_for_a_day(registry: Registry, call: IdempotentCall) -> None:
    first = roll_back(registry, call)
    assert roll_back(registry, call) == first
    with pytest.raises(KeyReused, match="'first' was used for another call"):
        roll_back(registry, replace(call, digest="1" * 64))
    assert registry.aliases.current(LEAGUE) == {"champion": 2}
    other, _ = registry.keys.create("other", ["promote"])
    assert roll_back(registry, replace(call, owner=other.id)).version == 1, "keys are separate for each owner"
    assert roll_back(registry, call) == first, "even after other changes"
    registry.aliases.set(LEAGUE, "champion", 3, expected=1, actor="test", reason="test")
    assert roll_back(registry, replace(call, key="second")).version == 1
    registry.aliases.set(LEAGUE, "champion", 3, expected=1, actor="test", reason="test")
    with registry.database.write() as session:
        session.execute(update(IdempotentCallTable).values(at=datetime.now(UTC) - KEPT - timedelta(minutes=1)))
    assert roll_back(registry, call).version == 1


def test_each_kind_of_call_can_be_repeated(registry: Registry, call: IdempotentCall) -> None:
    calls: dict[str, Callable[[IdempotentCall], Any]] = {
        "a canary": lambda call: registry.traffic.set(
            LEAGUE, canary=Portion(2, 0.1), actor="bot", reason="test", call=call
        ),
        "an evaluation": lambda call: registry.evaluations.submit(LEAGUE, {}, actor="bot", max_active=8, call=call),
    }
    for name, apply in calls.items():
        first = apply(replace(call, key=name))
        assert apply(replace(call, key=name)) == first
        with pytest.raises(KeyReused):
            apply(replace(call, key=name, digest="1" * 64))
    assert len(registry.evaluations.newest(LEAGUE)) == 1
