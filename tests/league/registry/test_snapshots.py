"""Snapshots are stored with a mark of their data, which changes when the data changes."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from sqlalchemy.exc import StatementError

from league.errors import UnknownLeague
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.support.leagues.ledger_matches import SCHEDULE, play_match
from tests.support.leagues.registries import LEAGUE, config, interface, publish, registered


def test_a_snapshot_is_stored_with_its_mark(registry: Registry) -> None:
    assert registry.snapshots.get(LEAGUE, "leaderboard") is None
    registry.snapshots.put(LEAGUE, {"leaderboard": [1, 2], "payoff": None}, mark="a")
    first = registry.snapshots.get(LEAGUE, "leaderboard")
    assert first is not None
    assert (first.document, first.mark) == ([1, 2], "a")
    nothing = registry.snapshots.get(LEAGUE, "payoff")
    assert nothing is not None
    assert nothing.document is None
    registry.snapshots.put(LEAGUE, {"leaderboard": {"games": 3}, "payoff": None}, mark="b")
    second = registry.snapshots.get(LEAGUE, "leaderboard")
    assert second is not None
    assert (second.document, second.mark) == ({"games": 3}, "b")
    assert second.at >= first.at
    assert registry.snapshots.marks(LEAGUE) == {"payoff": "b", "leaderboard": "b"}


def test_a_part_of_all_leagues_is_read_at_once(registry: Registry) -> None:
    registered(registry, "chess")
    assert registry.snapshots.of_part("summary") == {}
    registry.snapshots.put(LEAGUE, {"summary": {"games": 1}, "other": 0}, mark="a")
    registry.snapshots.put("chess", {"summary": {"games": 2}}, mark="a")
    found = registry.snapshots.of_part("summary")
    assert {league: row.document["games"] for league, row in found.items()} == {"chess": 2, LEAGUE: 1}


def test_several_parts_are_stored_together_or_not_at_all(registry: Registry) -> None:
    with pytest.raises((StatementError, ValueError), match="not JSON compliant"):
        registry.snapshots.put(LEAGUE, {"a": 1, "b": float("nan")}, mark="a")
    assert registry.snapshots.marks(LEAGUE) == {}


def test_an_unknown_league_is_reported(registry: Registry) -> None:
    with pytest.raises(UnknownLeague, match="chess"):
        registry.snapshots.get("chess", "leaderboard")
    with pytest.raises(UnknownLeague, match="chess"):
        registry.snapshots.put("chess", {"leaderboard": []}, mark="a")


CHANGES: dict[str, Callable[[Registry], object]] = {
    "a match": lambda registry: Ledger(registry).append(play_match(SCHEDULE, 1)),
    "a purge": lambda registry: Ledger(registry).purge([SCHEDULE.id]),
    "a version": lambda registry: publish(registry, "run/1"),
    "a promotion": lambda registry: registry.aliases.set(
        LEAGUE, "champion", 1, expected=None, actor="ada", reason="first"
    ),
    "a verdict": lambda registry: registry.verdicts.open(LEAGUE, 1, "script:random", "another", {}),
    "its end": lambda registry: registry.verdicts.close(SCHEDULE.id, "reject", {}),
    "its being voided": lambda registry: registry.verdicts.void(SCHEDULE.id, "a mistake"),
    "another environment": lambda registry: registry.leagues.register(
        config(kwargs={"render_mode": "rgb_array"}), interface()
    ),
}


def test_the_mark_of_a_league_changes_with_its_data(registry: Registry) -> None:
    publish(registry, "run/0")
    ledger = Ledger(registry)
    ledger.open(SCHEDULE)
    ledger.append(play_match(SCHEDULE, 0))
    registry.verdicts.open(LEAGUE, 1, "script:random", SCHEDULE.id, {})
    registered(registry, "chess", versions=1)
    seen = [registry.snapshots.current_marks()]
    for what, change in CHANGES.items():
        if what == "its being voided":
            registry.verdicts.close("another", "reject", {})
            seen.append(registry.snapshots.current_marks())
        change(registry)
        now = registry.snapshots.current_marks()
        assert now[LEAGUE] not in {before[LEAGUE] for before in seen}, what
        assert now["chess"] == seen[0]["chess"]
        seen.append(now)


def test_a_mark_is_stable_without_relevant_changes(registry: Registry) -> None:
    ledger = Ledger(registry)
    marks = registry.snapshots.current_marks()
    ledger.open(replace(SCHEDULE, id="not played"))
    registry.keys.create("bot", ["read"])
    assert registry.snapshots.current_marks() == marks


def test_verdict_reasons_are_read_without_the_curves(registry: Registry) -> None:
    verdict = {"outcome": "reject", "reason": "It is not the stronger one.", "curve": [[1, 0.5]] * 400}
    registry.snapshots.put(LEAGUE, {"verdict/a": verdict, "verdict/b": verdict, "summary": {}}, mark="a")
    assert registry.snapshots.verdict_reasons(LEAGUE, ["a", "c"]) == {"a": ("reject", "It is not the stronger one.")}
    assert registry.snapshots.verdict_reasons("chess", ["a"]) == {}
    assert registry.snapshots.verdict_reasons(LEAGUE, []) == {}
