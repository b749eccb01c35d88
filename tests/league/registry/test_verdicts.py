"""Verdicts, and the nightly runs that open them."""

import math

import pytest
from sqlalchemy.exc import StatementError

from league.errors import (
    Conflict,
    InvalidInput,
    InvalidReference,
    NotFound,
    UnknownVerdict,
    UnknownVersion,
)
from league.registry.registry import Registry
from tests.support.leagues.registries import LEAGUE, registered

SETTINGS = {"model": "normalized", "elo0": 0.0, "elo1": 30.0, "alpha": 0.05, "beta": 0.05, "max_blocks": 2000}


EVIDENCE = {"llr": 2.97, "counts": [1, 2, 3, 4, 5]}


@pytest.fixture
def registry(empty: Registry) -> Registry:
    return registered(empty, versions=2)


def test_a_verdict_is_opened_once_and_closed_once(registry: Registry) -> None:
    opened = registry.verdicts.open(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS)
    assert (opened.candidate, opened.champion, opened.schedule) == (2, "tictactoe@1", "schedule-1")
    assert (opened.outcome, opened.evidence, opened.closed_at) == (None, None, None)
    assert registry.verdicts.open(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS) == opened
    with pytest.raises(Conflict, match="opened with candidate 2, not 1"):
        registry.verdicts.open(LEAGUE, 1, "tictactoe@1", "schedule-1", SETTINGS)
    with pytest.raises(Conflict, match="opened with settings"):
        registry.verdicts.open(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS | {"alpha": 0.1})
    registry.verdicts.close(opened.id, "promote", EVIDENCE)
    (closed,) = registry.verdicts.all(LEAGUE)
    registry.verdicts.close(opened.id, "promote", {"llr": 0.0})
    assert registry.verdicts.all(LEAGUE) == [closed]
    assert (closed.outcome, closed.evidence, closed.settings) == ("promote", EVIDENCE, SETTINGS)
    assert closed.closed_at is not None
    assert closed.closed_at >= closed.opened_at
    with pytest.raises(Conflict, match="is already 'promote'"):
        registry.verdicts.close("schedule-1", "reject", EVIDENCE)


def test_verdicts_are_listed_in_order_of_opening(registry: Registry) -> None:
    names = ["c", "a", "d", "b"]
    for name in names:
        registry.verdicts.open(LEAGUE, 2, "tictactoe@1", name, SETTINGS)
    assert [verdict.id for verdict in registry.verdicts.all(LEAGUE)] == names
    assert [row.id for row in registry.verdicts.newest(LEAGUE)] == names[::-1]
    assert [row.id for row in registry.verdicts.newest(LEAGUE, limit=2)] == names[:1:-1]
    assert [row.id for row in registry.verdicts.newest(LEAGUE, before="d", limit=5)] == names[1::-1]
    with pytest.raises(InvalidInput, match="before: league tictactoe has no verdict 'e'"):
        registry.verdicts.newest(LEAGUE, before="e")


def test_a_verdict_can_be_voided_unless_it_is_being_applied(registry: Registry) -> None:
    settings = {"gate": {"alpha": 0.01}}
    registry.verdicts.open(LEAGUE, 2, "tictactoe@1", "s", settings)
    voided = registry.verdicts.void("s", "voided by me: games of a broken machine")
    assert (voided.outcome, voided.alpha) == ("void", 0.01)
    assert voided.evidence == {"note": "voided by me: games of a broken machine"}
    assert voided.closed_at is not None
    assert registry.verdicts.void("s", "again") == voided
    with pytest.raises(Conflict, match="is already 'void'"):
        registry.verdicts.close("s", "promote", {})
    with pytest.raises(Conflict, match="cannot promote"):
        registry.aliases.set(LEAGUE, "champion", 2, expected=None, actor="a", reason="r", verdict="s")
    registry.verdicts.open(LEAGUE, 2, "script:random", "t", settings)
    registry.aliases.set(LEAGUE, "champion", 2, expected=None, actor="a", reason="r", verdict="t")
    with pytest.raises(Conflict, match="is being applied"):
        registry.verdicts.void("t", "why")
    registry.verdicts.close("t", "promote", {"llr": -3.0})
    assert registry.verdicts.void("t", "why").evidence == {"llr": -3.0, "note": "why"}
    assert registry.aliases.current(LEAGUE) == {"champion": 2}


def test_a_nightly_run_is_opened_once(registry: Registry) -> None:
    night = registry.nightly_runs.open(LEAGUE, [3, 2], 0.001)
    assert (night.candidates, night.alpha, night.report, night.ended_at) == ((2, 3), 0.001, None, None)
    assert registry.nightly_runs.open(LEAGUE, [1], 0.5) == night
    registry.nightly_runs.close(night.id, {"champion": "tictactoe@2"})
    registry.nightly_runs.close(night.id, {})
    (ended,) = registry.nightly_runs.all(LEAGUE)
    assert ended.report == {"champion": "tictactoe@2"}
    assert ended.ended_at is not None
    assert registry.nightly_runs.open(LEAGUE, [1], 0.5).candidates == (1,)
    assert len(registry.nightly_runs.all(LEAGUE)) == 2


def test_unknown_versions_and_verdicts_are_rejected(registry: Registry) -> None:
    with pytest.raises(UnknownVersion):
        registry.verdicts.open(LEAGUE, 9, "tictactoe@1", "schedule-1", SETTINGS)
    with pytest.raises(NotFound, match="no verdict 'schedule-9'"):
        registry.verdicts.close("schedule-9", "promote", EVIDENCE)


@pytest.fixture
def alike(registry: Registry) -> tuple[str, str]:
    """Two verdicts with equal beginnings of their digests."""
    ids = f"{LEAGUE}-verdict-0f3a62d1aa-1b", f"{LEAGUE}-verdict-0f3a62d1bb-1b"
    for number, verdict in enumerate(ids, start=1):
        registry.verdicts.open(LEAGUE, number, "script:random", verdict, SETTINGS)
    return ids


def test_a_verdict_is_found_by_a_unique_beginning(registry: Registry, alike: tuple[str, str]) -> None:
    first, second = alike
    for text in (first, "0f3a62d1a", f"{LEAGUE}-verdict-0f3a62d1a"):
        assert registry.verdicts.find(text).id == first
        assert registry.verdicts.find(text, LEAGUE).id == first
    assert registry.verdicts.find("0f3a62d1bb-1b").id == second
    assert registry.verdicts.get(first).short_id == "0f3a62d1"
    for text in ("", "%", "_", "62d1", "1b", f"{first}0"):
        with pytest.raises(UnknownVerdict):
            registry.verdicts.find(text)


def test_an_ambiguous_beginning_lists_the_candidates(registry: Registry, alike: tuple[str, str]) -> None:
    for text in ("0f3a", "0f3a62d1", LEAGUE):
        with pytest.raises(InvalidReference) as ambiguous:
            registry.verdicts.find(text)
        assert "0f3a62d1a (tictactoe@1 against script:random)" in str(ambiguous.value)
        assert "0f3a62d1b (tictactoe@2 against script:random)" in str(ambiguous.value)


def test_evidence_must_be_finite(registry: Registry) -> None:
    registry.verdicts.open(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS)
    with pytest.raises((StatementError, ValueError), match="not JSON compliant"):
        registry.verdicts.close("schedule-1", "promote", {"llr": math.inf})
    assert registry.verdicts.all(LEAGUE)[0].outcome is None


def test_the_last_verdict_of_a_league_is_the_last_one_closed(registry: Registry) -> None:
    assert registry.verdicts.last_closed() == {}
    registered(registry, "chess", versions=1)
    for name in ("first", "second", "third"):
        registry.verdicts.open(LEAGUE, 2, "tictactoe@1", name, SETTINGS)
    registry.verdicts.open("chess", 1, "script:random", "open", SETTINGS)
    registry.verdicts.close("second", "promote", EVIDENCE)
    registry.verdicts.close("first", "reject", EVIDENCE)
    last = registry.verdicts.last_closed()
    assert {league: (row.id, row.outcome) for league, row in last.items()} == {LEAGUE: ("first", "reject")}
