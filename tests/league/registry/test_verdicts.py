import math

import pytest
from sqlalchemy.exc import StatementError

from league.errors import Conflict, InvalidInput, NotFound, UnknownLeague, UnknownVersion
from league.registry.registry import Registry
from tests.league.registry.examples import LEAGUE, registered

SETTINGS = {"model": "normalized", "elo0": 0.0, "elo1": 30.0, "alpha": 0.05, "beta": 0.05, "max_blocks": 2000}
EVIDENCE = {"llr": 2.97, "counts": [1, 2, 3, 4, 5]}


@pytest.fixture
def registry(empty: Registry) -> Registry:
    return registered(empty, versions=2)


def test_a_verdict_is_opened_once_and_closed_once(registry: Registry) -> None:
    opened = registry.open_verdict(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS)
    assert (opened.candidate, opened.champion, opened.schedule) == (2, "tictactoe@1", "schedule-1")
    assert (opened.outcome, opened.evidence, opened.closed_at) == (None, None, None)
    assert registry.open_verdict(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS) == opened
    registry.close_verdict(opened.id, "promote", EVIDENCE)
    (closed,) = registry.verdicts(LEAGUE)
    registry.close_verdict(opened.id, "promote", {"llr": 0.0})
    assert registry.verdicts(LEAGUE) == [closed]
    assert (closed.outcome, closed.evidence, closed.settings) == ("promote", EVIDENCE, SETTINGS)
    assert closed.closed_at is not None
    assert closed.closed_at >= closed.opened_at


def test_a_verdict_does_not_change_its_mind(registry: Registry) -> None:
    registry.open_verdict(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS)
    registry.close_verdict("schedule-1", "reject", EVIDENCE)
    with pytest.raises(Conflict, match="is 'reject' already"):
        registry.close_verdict("schedule-1", "promote", EVIDENCE)


def test_a_schedule_has_one_verdict(registry: Registry) -> None:
    registry.open_verdict(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS)
    with pytest.raises(Conflict, match="opened with candidate 2, not 1"):
        registry.open_verdict(LEAGUE, 1, "tictactoe@1", "schedule-1", SETTINGS)
    with pytest.raises(Conflict, match="opened with settings"):
        registry.open_verdict(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS | {"alpha": 0.1})


def test_unknown_things_are_refused(registry: Registry) -> None:
    with pytest.raises(UnknownVersion):
        registry.open_verdict(LEAGUE, 9, "tictactoe@1", "schedule-1", SETTINGS)
    with pytest.raises(NotFound, match="no verdict 'schedule-9'"):
        registry.close_verdict("schedule-9", "promote", EVIDENCE)
    with pytest.raises(UnknownLeague):
        registry.verdicts("chess")


def test_evidence_is_finite_on_every_database(registry: Registry) -> None:
    registry.open_verdict(LEAGUE, 2, "tictactoe@1", "schedule-1", SETTINGS)
    with pytest.raises((StatementError, ValueError), match="not JSON compliant"):
        registry.close_verdict("schedule-1", "promote", {"llr": math.inf})
    assert registry.verdicts(LEAGUE)[0].outcome is None


def test_verdicts_are_listed_as_they_were_opened(registry: Registry) -> None:
    for schedule in ("b", "a", "c"):
        registry.open_verdict(LEAGUE, 2, "tictactoe@1", schedule, SETTINGS)
    assert [verdict.id for verdict in registry.verdicts(LEAGUE)] == ["b", "a", "c"]


def test_they_are_listed_newest_first(registry: Registry) -> None:
    names = ["c", "a", "d", "b"]
    for name in names:
        registry.open_verdict(LEAGUE, 2, "tictactoe@1", name, SETTINGS)
    assert [row.id for row in registry.newest_verdicts(LEAGUE)] == names[::-1]
    assert [row.id for row in registry.newest_verdicts(LEAGUE, limit=2)] == names[:1:-1]
    assert [row.id for row in registry.newest_verdicts(LEAGUE, before="d", limit=5)] == names[1::-1]
    with pytest.raises(InvalidInput, match="before: league tictactoe has no verdict 'e'"):
        registry.newest_verdicts(LEAGUE, before="e")


def test_each_league_s_last_verdict_is_the_one_that_was_closed_last(registry: Registry) -> None:
    assert registry.last_verdicts() == {}
    registered(registry, "chess", versions=1)
    for name in ("first", "second", "third"):
        registry.open_verdict(LEAGUE, 2, "tictactoe@1", name, SETTINGS)
    registry.open_verdict("chess", 1, "script:random", "open", SETTINGS)
    registry.close_verdict("second", "promote", EVIDENCE)
    registry.close_verdict("first", "reject", EVIDENCE)
    last = registry.last_verdicts()
    assert {league: (row.id, row.outcome) for league, row in last.items()} == {LEAGUE: ("first", "reject")}
