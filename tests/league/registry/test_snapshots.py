"""Snapshots are stored with a mark of their data, which changes when the data changes."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from sqlalchemy.exc import StatementError

from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.support.databases import on_both_databases
from tests.support.leagues.ledger_matches import SCHEDULE, play_match
from tests.support.leagues.registries import LEAGUE, config, interface, publish, registered


@on_both_databases
def test_a_snapshot_is_stored_with_its_mark(registry: Registry) -> None:
    assert registry.snapshots.get(LEAGUE, "leaderboard") is None
    with pytest.raises((StatementError, ValueError), match="not JSON compliant"):
        registry.snapshots.put(LEAGUE, {"payoff": 1, "leaderboard": float("nan")}, mark="a")
    assert registry.snapshots.marks(LEAGUE) == {}, "parts are stored together or not at all"
    stored = []
    for document, mark in (([1, 2], "a"), ({"games": 3}, "b")):
        registry.snapshots.put(LEAGUE, {"leaderboard": document, "payoff": None}, mark=mark)
        rows = [registry.snapshots.get(LEAGUE, part) for part in ("leaderboard", "payoff")]
        assert [(row.document, row.mark) for row in rows if row] == [(document, mark), (None, mark)]
        stored += rows[:1]
    assert stored[1].at >= stored[0].at
    assert registry.snapshots.marks(LEAGUE) == {"payoff": "b", "leaderboard": "b"}
    registered(registry, "chess")
    registry.snapshots.put("chess", {"leaderboard": {"games": 2}}, mark="a")
    documents = {league: row.document for league, row in registry.snapshots.of_part("leaderboard").items()}
    assert documents == {"chess": {"games": 2}, LEAGUE: {"games": 3}}
    assert registry.snapshots.of_part("summary") == {}


CHANGES: dict[str, Callable[[Registry], object]] = {
    "a match": lambda registry: Ledger(registry).extend([play_match(SCHEDULE, 1)]),
    "a purge": lambda registry: Ledger(registry).purge([SCHEDULE.id]),
    "a version": lambda registry: publish(registry, "run/1"),
    "a promotion": lambda registry: registry.aliases.set(
        LEAGUE, "champion", 1, expected=None, actor="ada", reason="first"
    ),
    "a verdict": lambda registry: registry.verdicts.open(LEAGUE, 1, "script:random", "another", {}),
    "its end": lambda registry: registry.verdicts.close(SCHEDULE.id, "reject", {}),
    "the end of the other": lambda registry: registry.verdicts.close("another", "reject", {}),
    "its being voided": lambda registry: registry.verdicts.void(SCHEDULE.id, "a mistake"),
    "another environment": lambda registry: registry.leagues.register(
        config(kwargs={"render_mode": "rgb_array"}), interface()
    ),
}


def test_the_mark_of_a_league_changes_with_its_data(registry: Registry) -> None:
    publish(registry, "run/0")
    ledger = Ledger(registry)
    ledger.open(SCHEDULE)
    ledger.extend([play_match(SCHEDULE, 0)])
    registry.verdicts.open(LEAGUE, 1, "script:random", SCHEDULE.id, {})
    registered(registry, "chess", versions=1)
    marks = [registry.snapshots.current_marks()]
    ledger.open(replace(SCHEDULE, id="not played"))
    registry.keys.create("bot", ["read"])
    assert registry.snapshots.current_marks() == marks[0]
    for what, change in CHANGES.items():
        change(registry)
        marks.append(registry.snapshots.current_marks())
        assert marks[-1][LEAGUE] not in {before[LEAGUE] for before in marks[:-1]}, what
        assert marks[-1]["chess"] == marks[0]["chess"]


def test_verdict_reasons_are_read_without_the_curves(registry: Registry) -> None:
    verdict = {"outcome": "reject", "reason": "It is not the stronger one.", "curve": [[1, 0.5]] * 400}
    registry.snapshots.put(LEAGUE, {"verdict/a": verdict, "verdict/b": verdict, "summary": {}}, mark="a")
    assert registry.snapshots.verdict_reasons(LEAGUE, ["a", "c"]) == {"a": ("reject", "It is not the stronger one.")}
    assert registry.snapshots.verdict_reasons("chess", ["a"]) == {}
    assert registry.snapshots.verdict_reasons(LEAGUE, []) == {}
