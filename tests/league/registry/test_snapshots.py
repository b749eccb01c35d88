"""Snapshots: kept with a mark of what they were computed from, which changes with whatever they follow from."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from sqlalchemy.exc import StatementError

from league.errors import UnknownLeague
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.league.registry.examples import LEAGUE, config, interface, publish, registered
from tests.league.results.test_ledger import SCHEDULE, played


def test_a_part_is_there_with_its_mark_once_it_was_put(registry: Registry) -> None:
    assert registry.snapshot(LEAGUE, "standings") is None
    registry.put_snapshots(LEAGUE, {"standings": [1, 2], "payoff": None}, mark="a")
    first = registry.snapshot(LEAGUE, "standings")
    assert first is not None
    assert (first.document, first.mark) == ([1, 2], "a")
    nothing = registry.snapshot(LEAGUE, "payoff")
    assert nothing is not None
    assert nothing.document is None
    registry.put_snapshots(LEAGUE, {"standings": {"games": 3}, "payoff": None}, mark="b")
    second = registry.snapshot(LEAGUE, "standings")
    assert second is not None
    assert (second.document, second.mark) == ({"games": 3}, "b")
    assert second.at >= first.at
    assert registry.snapshot_marks(LEAGUE) == {"payoff": "b", "standings": "b"}


def test_the_same_part_of_all_leagues_is_read_at_once(registry: Registry) -> None:
    registered(registry, "chess")
    assert registry.snapshots("summary") == {}
    registry.put_snapshots(LEAGUE, {"summary": {"games": 1}, "other": 0}, mark="a")
    registry.put_snapshots("chess", {"summary": {"games": 2}}, mark="a")
    found = registry.snapshots("summary")
    assert {league: row.document["games"] for league, row in found.items()} == {"chess": 2, LEAGUE: 1}


def test_of_several_parts_all_or_none_are_put(registry: Registry) -> None:
    with pytest.raises((StatementError, ValueError), match="not JSON compliant"):
        registry.put_snapshots(LEAGUE, {"a": 1, "b": float("nan")}, mark="a")
    assert registry.snapshot_marks(LEAGUE) == {}


def test_a_league_that_is_not_there_is_named(registry: Registry) -> None:
    with pytest.raises(UnknownLeague, match="chess"):
        registry.snapshot("chess", "standings")
    with pytest.raises(UnknownLeague, match="chess"):
        registry.put_snapshots("chess", {"standings": []}, mark="a")


CHANGES: dict[str, Callable[[Registry], object]] = {
    "a match": lambda registry: Ledger(registry).append(played(SCHEDULE, 1)),
    "a purge": lambda registry: Ledger(registry).purge([SCHEDULE.id]),
    "a version": lambda registry: publish(registry, "run/1"),
    "a promotion": lambda registry: registry.set_alias(
        LEAGUE, "champion", 1, expected=None, actor="ada", reason="first"
    ),
    "a verdict": lambda registry: registry.open_verdict(LEAGUE, 1, "script:random", "another", {}),
    "its end": lambda registry: registry.close_verdict(SCHEDULE.id, "reject", {}),
    "its being voided": lambda registry: registry.void_verdict(SCHEDULE.id, "a mistake"),
    "another environment": lambda registry: registry.register(config(kwargs={"render_mode": "rgb_array"}), interface()),
}


def test_a_league_s_mark_changes_with_whatever_follows_from_it(registry: Registry) -> None:
    publish(registry, "run/0")
    ledger = Ledger(registry)
    ledger.open(SCHEDULE)
    ledger.append(played(SCHEDULE, 0))
    registry.open_verdict(LEAGUE, 1, "script:random", SCHEDULE.id, {})
    registered(registry, "chess", versions=1)
    seen = [registry.marks()]
    for what, change in CHANGES.items():
        if what == "its being voided":
            registry.close_verdict("another", "reject", {})
            seen.append(registry.marks())
        change(registry)
        now = registry.marks()
        assert now[LEAGUE] not in {before[LEAGUE] for before in seen}, what
        assert now["chess"] == seen[0]["chess"]
        seen.append(now)


def test_a_mark_stays_while_nothing_follows(registry: Registry) -> None:
    ledger = Ledger(registry)
    before = registry.marks()
    ledger.open(replace(SCHEDULE, id="not played"))
    registry.create_key("bot", ["read"])
    assert registry.marks() == before


def test_of_judgements_that_were_computed_the_reasons_are_read_alone(registry: Registry) -> None:
    judgement = {"outcome": "reject", "reason": "It is not the stronger one.", "curve": [[1, 0.5]] * 400}
    registry.put_snapshots(LEAGUE, {"verdict/a": judgement, "verdict/b": judgement, "summary": {}}, mark="a")
    assert registry.verdict_reasons(LEAGUE, ["a", "c"]) == {"a": ("reject", "It is not the stronger one.")}
    assert registry.verdict_reasons("chess", ["a"]) == {}
    assert registry.verdict_reasons(LEAGUE, []) == {}
