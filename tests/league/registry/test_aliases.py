"""Aliases move by compare-and-set, have an audit trail, and can be rolled back."""

from datetime import UTC, datetime, timedelta, tzinfo
from typing import Any

import pytest

from league.errors import AliasMoved, InvalidReference, NothingToRollBack, UnknownAlias, UnknownVersion
from league.registry import aliases
from league.registry.registry import Registry
from league.registry.storage.rows import AliasEvent
from tests.support.leagues.registries import LEAGUE, registered


@pytest.fixture
def registry(empty: Registry) -> Registry:
    return registered(empty, versions=3)


def promote(registry: Registry, version: int, expected: Any, **more: Any) -> AliasEvent:
    return registry.aliases.set(LEAGUE, "champion", version, expected=expected, actor="ann", reason="better", **more)


def test_an_alias_is_set_moved_and_resolved(registry: Registry) -> None:
    promote(registry, 1, expected=None)
    registry.aliases.set(LEAGUE, "candidate", 1, expected=None, actor="ann", reason="to look at")
    promote(registry, 2, expected=1)
    assert registry.aliases.current(LEAGUE) == {"champion": 2, "candidate": 1}
    events = {alias: registry.aliases.history(LEAGUE, alias)[0].id for alias in ("champion", "candidate")}
    assert registry.aliases.all() == {
        (LEAGUE, "champion"): (2, events["champion"]),
        (LEAGUE, "candidate"): (1, events["candidate"]),
    }
    assert registry.versions.resolve("tictactoe@champion").number == 2
    assert [version.aliases for version in registry.versions.all(LEAGUE)] == [("candidate",), ("champion",), ()]


def test_unknown_versions_and_aliases_are_reported(registry: Registry) -> None:
    with pytest.raises(UnknownVersion, match="league tictactoe has no version 9; the newest is 3"):
        promote(registry, 9, expected=None)
    with pytest.raises(UnknownAlias, match="league tictactoe has no alias 'best'; known: none yet"):
        registry.versions.resolve("tictactoe@best")
    with pytest.raises(InvalidReference, match="must not be all digits"):
        registry.aliases.set(LEAGUE, "7", 1, expected=None, actor="ann", reason="")


def test_an_unknown_verdict_cannot_promote(registry: Registry) -> None:
    with pytest.raises(Exception, match=r"(?i)foreign key"):
        promote(registry, 1, expected=None, verdict="never opened")
    assert registry.aliases.current(LEAGUE) == {}


def test_history_at_a_time(registry: Registry) -> None:
    first = promote(registry, 1, expected=None)
    second = promote(registry, 2, expected=1)
    assert registry.aliases.history(LEAGUE) == [second, first]
    assert registry.aliases.history(LEAGUE, at=first.at - timedelta(seconds=1)) == []
    assert registry.aliases.history(LEAGUE, at=first.at) == [first]
    assert registry.aliases.history(LEAGUE, at=second.at - timedelta(microseconds=1)) == [first]
    assert registry.aliases.history(LEAGUE, at=second.at + timedelta(days=1)) == [second]
    assert registry.aliases.history(LEAGUE, "candidate") == []


def test_a_clock_that_is_behind_keeps_the_order_of_events(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    first = promote(registry, 1, expected=None)

    class BehindClock(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:
            return first.at - timedelta(hours=1)

    monkeypatch.setattr(aliases, "datetime", BehindClock)
    second = promote(registry, 2, expected=1)
    assert second.at == first.at
    assert registry.aliases.history(LEAGUE, at=second.at) == [second]


def test_refusals_name_what_the_alias_is_at(registry: Registry) -> None:
    with pytest.raises(AliasMoved, match="is not set, expected tictactoe@1"):
        promote(registry, 2, expected=1)
    with pytest.raises(NothingToRollBack, match="is not set: promote a version"):
        registry.aliases.rollback(LEAGUE, actor="bob", reason="")
    event = promote(registry, 1, expected=None)
    assert promote(registry, 1, expected=1) == event, "it is there already"
    for expected, message in ((None, "not set"), (2, "tictactoe@2")):
        with pytest.raises(AliasMoved, match=f"is at tictactoe@1 now, expected {message}"):
            promote(registry, 3, expected=expected)
    with pytest.raises(NothingToRollBack, match="no version before tictactoe@1 to return to"):
        registry.aliases.rollback(LEAGUE, actor="bob", reason="")
    assert registry.aliases.history(LEAGUE) == [event]


def test_an_event_has_actor_time_reason_and_verdict(registry: Registry) -> None:
    before = datetime.now(UTC)
    verdict = registry.verdicts.open(LEAGUE, 2, "script:random", "schedule-1", {})
    promote(registry, 1, expected=None)
    event = promote(registry, 2, expected=1, verdict=verdict.id)
    assert (event.actor, event.reason, event.verdict) == ("ann", "better", "schedule-1")
    assert before <= event.at <= datetime.now(UTC)
    rollback = registry.aliases.rollback(LEAGUE, actor="bob", reason="it loses")
    assert (rollback.kind, rollback.actor, rollback.reason) == ("rollback", "bob", "it loses")
    history = registry.aliases.history(LEAGUE)
    assert history[:2] == [rollback, event]
    assert registry.aliases.history(LEAGUE, limit=1) == history[:1]
    assert registry.aliases.history(LEAGUE, before=history[0].id, limit=3) == history[1:]
