"""A change that comes again is not applied again."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import update

from league.errors import AliasMoved, KeyReused
from league.registry.aliases import ANY
from league.registry.idempotency import KEPT, Call
from league.registry.registry import Registry
from league.registry.rows import AliasEvent
from league.registry.tables import IdempotentCall
from tests.league.registry.examples import LEAGUE, publish


@pytest.fixture
def call(registry: Registry) -> Call:
    """A call on a league whose champion was version 1, then 2, then 3."""
    for number in (1, 2, 3):
        publish(registry, f"run/{number}")
        registry.set_alias(LEAGUE, "champion", number, expected=ANY, actor="test", reason="test")
    key, _ = registry.create_key("bot", ["promote"])
    return Call(owner=key.id, key="first", digest="0" * 64)


def roll_back(registry: Registry, call: Call) -> AliasEvent:
    return registry.rollback(LEAGUE, actor="bot", reason="test", call=call)


def test_a_call_that_comes_again_gets_the_same_answer(registry: Registry, call: Call) -> None:
    first = roll_back(registry, call)
    assert roll_back(registry, call) == first
    assert registry.aliases(LEAGUE) == {"champion": 2}
    assert roll_back(registry, replace(call, key="second")).version == 1
    assert roll_back(registry, call) == first, "whatever has happened since"


def test_the_key_of_another_call_is_refused(registry: Registry, call: Call) -> None:
    roll_back(registry, call)
    with pytest.raises(KeyReused, match="'first' was used for another call"):
        roll_back(registry, replace(call, digest="1" * 64))
    assert registry.aliases(LEAGUE) == {"champion": 2}


def test_keys_belong_to_their_owner(registry: Registry, call: Call) -> None:
    roll_back(registry, call)
    other, _ = registry.create_key("other", ["promote"])
    assert roll_back(registry, replace(call, owner=other.id)).version == 1


def test_a_call_that_failed_may_be_tried_again(registry: Registry, call: Call) -> None:
    def move() -> AliasEvent:
        return registry.set_alias(LEAGUE, "champion", 1, expected=2, actor="bot", reason="test", call=call)

    with pytest.raises(AliasMoved):
        move()
    registry.rollback(LEAGUE, actor="test", reason="test")
    assert move().version == 1


def test_of_many_at_once_one_is_applied(registry: Registry, call: Call) -> None:
    with ThreadPoolExecutor(8) as pool:
        events = list(pool.map(lambda _: roll_back(registry, call), range(8)))
    assert len({event.id for event in events}) == 1
    assert registry.aliases(LEAGUE) == {"champion": 2}


def test_a_call_is_forgotten_after_a_day(registry: Registry, call: Call) -> None:
    roll_back(registry, call)
    with registry.database.write() as session:
        session.execute(update(IdempotentCall).values(at=datetime.now(UTC) - KEPT - timedelta(minutes=1)))
    assert roll_back(registry, call).version == 1
