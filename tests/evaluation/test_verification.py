"""A verdict is computed again; whatever somebody has changed of it is found."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from evaluation.forfeits import forfeits
from evaluation.nightly import nightly
from evaluation.verification import verify
from league.errors import EnvironmentMismatch, InvalidInput, NotFound, VerdictRefuted
from league.registry import tables
from league.registry.registry import Registry
from league.registry.rows import VerdictRow
from league.results.ledger import Ledger
from tests.evaluation import examples
from tests.evaluation.test_forfeits import reckless
from tests.evaluation.test_nightly import CONFIG, MIDDLING, STRONG, WEAK, league_of


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Registry:
    registry = league_of(tmp_path_factory.mktemp("judged"), WEAK, MIDDLING, STRONG, MIDDLING)
    nightly(CONFIG, registry=registry)
    return registry


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """One that a test may change."""
    registry = league_of(tmp_path, STRONG, WEAK)
    nightly(CONFIG, registry=registry)
    return registry


def verdicts(registry: Registry) -> list[VerdictRow]:
    return registry.verdicts(examples.LEAGUE)


def test_every_verdict_of_a_night_holds_and_its_games_come_out_the_same(judged: Registry) -> None:
    assert {row.outcome for row in verdicts(judged)} >= {"promote", "reject"}
    for row in verdicts(judged):
        found = verify(row.id, registry=judged, replays=5)
        assert (found.outcome, found.replayed) == (row.outcome, 5)
        assert found.matches >= row.evidence["blocks"]  # type: ignore[index]


def test_it_says_the_same_in_another_process_with_its_own_registry(judged: Registry) -> None:
    row = verdicts(judged)[0]
    assert verify(row.id, registry=Registry.open(judged.storage)) == verify(row.id, registry=judged)


CHANGES: dict[str, Any] = {
    "outcome": "reject",
    "llr": 3.0,
    "bounds": [-2.0, 2.0],
    "blocks": 1,
    "games": 7,
    "distinct_games": 2,
    "score": 0.99,
    "elo": 1000.0,
    "interval": [999.0, 1001.0],
    "counts": [0, 0, 0, 0, 99],
    "promoted": False,
    "candidate": "tictactoe@9",
    "opponent": "script:one_ply",
}


@pytest.mark.parametrize("name", CHANGES)
def test_whatever_is_changed_in_the_evidence_is_named(registry: Registry, name: str) -> None:
    row = verdicts(registry)[0]
    assert row.outcome == "promote"
    with registry.database.write() as session:
        stored = session.get_one(tables.Verdict, row.id)
        stored.evidence = {**stored.evidence, name: CHANGES[name]}  # type: ignore[dict-item]
    with pytest.raises(VerdictRefuted, match=f"{name} is .*by the games"):
        verify(row.id, registry=registry)


def change_moves(registry: Registry, verdict: str, change: Callable[[list[Any]], None], position: int = 0) -> None:
    with registry.database.write() as session:
        match = session.scalars(select(tables.Match).filter_by(schedule=verdict, position=position)).one()
        moves = json.loads(match.moves)
        change(moves)
        match.moves = json.dumps(moves)


def test_a_score_that_its_returns_do_not_say(registry: Registry) -> None:
    row = verdicts(registry)[0]

    def change(moves: list[Any]) -> None:
        first = moves[2][0]
        first[3] = list(reversed(first[3])) if first[3][0] != first[3][1] else [1.0, 0.0]

    change_moves(registry, row.id, change)
    with pytest.raises(VerdictRefuted, match="did not ask for"):
        verify(row.id, registry=registry)


def test_a_match_that_is_gone(registry: Registry) -> None:
    row = verdicts(registry)[0]
    with registry.database.write() as session:
        session.delete(session.scalars(select(tables.Match).filter_by(schedule=row.id, position=1)).one())
    with pytest.raises(VerdictRefuted, match="has no match 1"):
        verify(row.id, registry=registry)


def test_a_game_that_was_never_played_so_is_found_by_playing_it(registry: Registry) -> None:
    """Returns and scores that agree with one another and with the evidence are believed until the game is replayed."""
    row = verdicts(registry)[0]

    def change(moves: list[Any]) -> None:
        for game in moves[2]:
            game[1] = game[1][:-1]

    change_moves(registry, row.id, change)
    verify(row.id, registry=registry)
    with pytest.raises(EnvironmentMismatch, match="cannot be replayed"):
        verify(row.id, registry=registry, replays=2)


def test_a_void_verdict_holds_as_far_as_it_went(tmp_path: Path) -> None:
    registry = league_of(tmp_path, STRONG, WEAK)
    row = registry.league(examples.LEAGUE)
    from evaluation.verdicts import conclude, open_verdict

    open_verdict(registry, row, 2, "script:random")
    registry.set_alias(examples.LEAGUE, "champion", 1, expected=None, actor="me", reason="first")
    (verdict,) = verdicts(registry)
    assert conclude(registry, verdict).outcome == "void"
    assert verify(verdict.id, registry=registry).outcome == "void"


def test_a_verdict_on_a_version_that_forfeits_holds(tmp_path: Path) -> None:
    registry = league_of(tmp_path, STRONG, reckless(crashes=True))
    nightly(CONFIG, registry=registry)
    row = verdicts(registry)[-1]
    lost = forfeits(Ledger(registry).matches(league=row.league, schedule=row.schedule), "tictactoe@2")
    assert (row.candidate, row.outcome) == (2, "reject")
    assert lost
    assert verify(row.id, registry=registry, replays=8).replayed == 8

    def change(moves: list[Any]) -> None:
        for game in moves[2]:
            for forfeit in game[4:]:
                forfeit[1] = "player_1" if forfeit[1] == "player_2" else "player_2"

    for match in range(row.evidence["blocks"]):  # type: ignore[index]
        change_moves(registry, row.id, change, match)
    with pytest.raises(EnvironmentMismatch, match="who had not to act for it there"):
        verify(row.id, registry=registry, replays=8)


def test_there_must_be_a_verdict_and_it_must_be_closed(tmp_path: Path) -> None:
    registry = league_of(tmp_path, STRONG)
    with pytest.raises(NotFound, match="no verdict 'x'"):
        verify("x", registry=registry)
    from evaluation.verdicts import open_verdict

    verdict = open_verdict(registry, registry.league(examples.LEAGUE), 1, "script:random")
    with pytest.raises(InvalidInput, match="is open"):
        verify(verdict.id, registry=registry)
