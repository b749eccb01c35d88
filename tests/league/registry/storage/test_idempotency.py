"""A repeated call is applied once."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import update

from league.errors import AliasMoved, KeyReused
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.idempotency import KEPT, IdempotentCall
from league.registry.storage.rows import AliasEvent
from league.registry.storage.tables import IdempotentCallTable
from tests.support.databases import on_both_databases
from tests.support.leagues.registries import LEAGUE, publish

pytestmark = on_both_databases


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
