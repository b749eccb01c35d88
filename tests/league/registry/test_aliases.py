"""Aliases move by compare-and-set, leave an audit trail, and go back along it."""

from datetime import UTC, datetime, timedelta
from itertools import count
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from league.errors import (
    AliasMoved,
    InvalidReference,
    NothingToRollBack,
    UnknownAlias,
    UnknownLeague,
    UnknownVersion,
)
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.rows import AliasEvent
from tests.league.registry.examples import LEAGUE, registered


@pytest.fixture
def registry(empty: Registry) -> Registry:
    return registered(empty, versions=3)


def promote(registry: Registry, version: int, expected: Any, **more: Any) -> AliasEvent:
    return registry.set_alias(LEAGUE, "champion", version, expected=expected, actor="ann", reason="better", **more)


def test_an_alias_is_set_moved_and_resolved(registry: Registry) -> None:
    promote(registry, 1, expected=None)
    registry.set_alias(LEAGUE, "candidate", 1, expected=None, actor="ann", reason="to look at")
    promote(registry, 2, expected=1)
    assert registry.aliases(LEAGUE) == {"champion": 2, "candidate": 1}
    assert registry.all_aliases() == {(LEAGUE, "champion"): 2, (LEAGUE, "candidate"): 1}
    assert registry.resolve("tictactoe@champion").number == 2
    assert [version.aliases for version in registry.versions(LEAGUE)] == [("candidate",), ("champion",), ()]


def test_the_event_says_who_when_why_and_on_which_verdict(registry: Registry) -> None:
    before = datetime.now(UTC)
    verdict = registry.open_verdict(LEAGUE, 2, "script:random", "schedule-1", {})
    event = promote(registry, 2, expected=None, verdict=verdict.id)
    assert (event.kind, event.version, event.previous) == ("set", 2, None)
    assert (event.actor, event.reason, event.verdict) == ("ann", "better", "schedule-1")
    assert before <= event.at <= datetime.now(UTC)
    assert registry.history(LEAGUE) == [event]


@pytest.mark.parametrize(
    ("expected", "message"),
    [
        (None, "is at tictactoe@1 now, expected not set"),
        (2, "is at tictactoe@1 now, expected tictactoe@2"),
    ],
)
def test_a_compare_and_set_that_lost_changes_nothing(registry: Registry, expected: int | None, message: str) -> None:
    first = promote(registry, 1, expected=None)
    with pytest.raises(AliasMoved, match=message):
        promote(registry, 3, expected=expected)
    assert registry.aliases(LEAGUE) == {"champion": 1}
    assert registry.history(LEAGUE) == [first]


def test_an_alias_that_is_expected_must_exist(registry: Registry) -> None:
    with pytest.raises(AliasMoved, match="is not set, expected tictactoe@1"):
        promote(registry, 2, expected=1)


def test_any_version_may_be_expected(registry: Registry) -> None:
    assert promote(registry, 1, expected=ANY).previous is None
    assert promote(registry, 2, expected=ANY).previous == 1


def test_setting_an_alias_to_where_it_is_leaves_it_alone(registry: Registry) -> None:
    event = promote(registry, 1, expected=None)
    assert promote(registry, 1, expected=1) == event
    assert registry.history(LEAGUE) == [event]


def test_unknown_things_are_named(registry: Registry) -> None:
    with pytest.raises(UnknownVersion, match="league tictactoe has no version 9; the newest is 3"):
        promote(registry, 9, expected=None)
    with pytest.raises(UnknownLeague):
        registry.set_alias("chess", "champion", 1, expected=None, actor="ann", reason="")
    with pytest.raises(UnknownLeague):
        registry.history("chess")
    with pytest.raises(UnknownAlias, match="league tictactoe has no alias 'best'; known: none yet"):
        registry.resolve("tictactoe@best")
    with pytest.raises(InvalidReference, match="must not be all digits"):
        registry.set_alias(LEAGUE, "7", 1, expected=None, actor="ann", reason="")


def test_an_unknown_verdict_promotes_nobody(registry: Registry) -> None:
    with pytest.raises(Exception, match=r"(?i)foreign key"):
        promote(registry, 1, expected=None, verdict="never opened")
    assert registry.aliases(LEAGUE) == {}


def test_history_tells_what_was_in_force_at_a_time(registry: Registry) -> None:
    first = promote(registry, 1, expected=None)
    second = promote(registry, 2, expected=1)
    assert registry.history(LEAGUE) == [second, first]
    assert registry.history(LEAGUE, at=first.at - timedelta(seconds=1)) == []
    assert registry.history(LEAGUE, at=first.at) == [first]
    assert registry.history(LEAGUE, at=second.at - timedelta(microseconds=1)) == [first]
    assert registry.history(LEAGUE, at=second.at + timedelta(days=1)) == [second]
    assert registry.history(LEAGUE, "candidate") == []


def test_history_comes_in_pages(registry: Registry) -> None:
    for version in (1, 2, 1, 2):
        registry.set_alias(LEAGUE, "champion", version, expected=ANY, actor="ada", reason="test")
    whole = registry.history(LEAGUE)
    assert [event.version for event in whole] == [2, 1, 2, 1]
    assert registry.history(LEAGUE, limit=3) == whole[:3]
    assert registry.history(LEAGUE, before=whole[1].id, limit=3) == whole[2:]


def test_rolling_back_returns_to_the_champion_before(registry: Registry) -> None:
    promote(registry, 1, expected=None)
    promote(registry, 2, expected=1)
    event = registry.rollback(LEAGUE, actor="bob", reason="it loses")
    assert (event.kind, event.version, event.previous) == ("rollback", 1, 2)
    assert (event.actor, event.reason) == ("bob", "it loses")
    assert registry.resolve("tictactoe@champion").number == 1
    assert len(registry.history(LEAGUE)) == 3


def test_there_must_be_somewhere_to_roll_back_to(registry: Registry) -> None:
    with pytest.raises(NothingToRollBack, match="was never set"):
        registry.rollback(LEAGUE, actor="bob", reason="")
    promote(registry, 1, expected=None)
    with pytest.raises(NothingToRollBack, match="no version before tictactoe@1"):
        registry.rollback(LEAGUE, actor="bob", reason="")


leagues = (f"league-{i}" for i in count())


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.sampled_from([1, 2, 3, "rollback"]), max_size=12))
def test_rollbacks_follow_the_stack_of_promotions(local: Registry, moves: list[int | str]) -> None:
    league = next(leagues)
    registered(local, league, versions=3)
    stack: list[int] = []
    for move in moves:
        if isinstance(move, int):
            expected = stack[-1] if stack else None
            local.set_alias(league, "champion", move, expected=expected, actor="ann", reason="better")
            if move != expected:
                stack.append(move)
        elif len(stack) > 1:
            stack.pop()
            assert local.rollback(league, actor="bob", reason="").version == stack[-1]
        else:
            with pytest.raises(NothingToRollBack):
                local.rollback(league, actor="bob", reason="")
        assert local.aliases(league) == ({"champion": stack[-1]} if stack else {})
    _assert_chained(local.history(league))


def _assert_chained(history: list[AliasEvent]) -> None:
    """Each event starts where the one before it ended, and no earlier."""
    ends = [None, *(event.version for event in history[::-1])]
    assert [event.previous for event in history[::-1]] == ends[:-1]
    assert [event.at for event in history] == sorted((event.at for event in history), reverse=True)
