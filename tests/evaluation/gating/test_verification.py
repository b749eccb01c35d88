"""Verification recomputes a verdict, and detects each modification."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from evaluation.gating.nightly import nightly
from evaluation.gating.verdicts import conclude, open_verdict
from evaluation.gating.verification import verify
from evaluation.matches.game_records import forfeits
from league.environments.implementation import implementation
from league.errors import InvalidInput, NotFound, VerdictRefuted
from league.registry.registry import Registry
from league.registry.storage import rows, tables
from league.registry.storage.rows import VerdictRow
from league.results.ledger import Ledger
from league.settings import Storage
from tests.support.databases import StorageAt, on_both_databases
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import CONFIG, MIDDLING, STRONG, WEAK, league_of, promote
from tests.support.policies.illegal_action_graph import illegal_action_graph
from tests.support.templates import copy_of

pytestmark = on_both_databases


@pytest.fixture(scope="module")
def gated(tmp_path_factory: pytest.TempPathFactory) -> Registry:
    registry = league_of(tmp_path_factory.mktemp("gated"), WEAK, MIDDLING, STRONG, MIDDLING)
    nightly(CONFIG, registry=registry)
    return registry


def build_judged(storage: Storage) -> Registry:
    registry = league_of(storage.home, STRONG, WEAK)
    nightly(CONFIG, registry=registry)
    return registry


@pytest.fixture
def registry(tmp_path: Path, storage_at: StorageAt) -> Registry:
    """A registry that a test may modify."""
    return copy_of(build_judged, storage_at(tmp_path))


def verdicts(registry: Registry) -> list[VerdictRow]:
    return registry.verdicts.all(tictactoe.LEAGUE)


def test_all_verdicts_of_a_run_are_verified_by_replay(gated: Registry) -> None:
    assert {row.outcome for row in verdicts(gated)} >= {"promote", "reject"}
    for row in verdicts(gated):
        result = verify(row.id, registry=gated, replays=5)
        assert (result.outcome, result.replayed) == (row.outcome, 5)
        assert result.matches >= row.evidence["blocks"]
        assert verify(row.id, registry=Registry.open(gated.storage), replays=5) == result


def test_games_are_replayed_in_the_stock_environment(gated: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(implementation(CONFIG.environment).vector, "step", None)
    assert verify(verdicts(gated)[-1].id, registry=gated, replays=3).replayed == 3


CHANGES: dict[str, Any] = {
    "outcome": "reject",
    "llr": 3.0,
    "bounds": [-2.0, 2.0],
    "blocks": 1,
    "games": 7,
    "unique_games": 2,
    "score": 0.99,
    "elo": 1000.0,
    "interval": [999.0, 1001.0],
    "counts": [0, 0, 0, 0, 99],
    "promoted": False,
    "candidate": "tictactoe@9",
    "opponent": "script:one_ply",
    "model": "returns",
}


def test_each_change_of_the_evidence_is_reported(registry: Registry, subtests: pytest.Subtests) -> None:
    row = verdicts(registry)[0]
    assert row.outcome == "promote"
    for name, value in CHANGES.items():
        with registry.database.write() as session:
            session.get_one(rows.VerdictRow, row.id).evidence = {**row.evidence, name: value}
        with subtests.test(name), pytest.raises(VerdictRefuted, match=f"{name} is .*but the games give"):
            verify(row.id, registry=registry)


def change_moves(registry: Registry, verdict: str, change: Callable[[list[Any]], None], position: int = 0) -> None:
    with registry.database.write() as session:
        match = session.scalars(select(tables.MatchTable).filter_by(schedule=verdict, position=position)).one()
        moves = json.loads(match.moves)
        change(moves)
        match.moves = json.dumps(moves)


def shorten(moves: list[Any]) -> None:
    for game in moves[2]:
        game[1] = game[1][:-1]


def test_a_score_that_contradicts_the_returns_and_a_missing_match_are_detected(registry: Registry) -> None:
    row = verdicts(registry)[0]

    def change(moves: list[Any]) -> None:
        first = moves[2][0]
        first[3] = list(reversed(first[3])) if first[3][0] != first[3][1] else [1.0, 0.0]

    change_moves(registry, row.id, change)
    with pytest.raises(VerdictRefuted, match="contradicts its schedule"):
        verify(row.id, registry=registry)
    with registry.database.write() as session:
        session.delete(session.scalars(select(tables.MatchTable).filter_by(schedule=row.id, position=0)).one())
    with pytest.raises(VerdictRefuted, match="lacks match 0 of"):
        verify(row.id, registry=registry)


def test_a_modified_game_is_detected_by_the_sums_and_by_replay(registry: Registry) -> None:
    """With the sums changed as well, consistent returns and scores are accepted until the game is replayed."""
    row = verdicts(registry)[0]
    change_moves(registry, row.id, shorten)
    with pytest.raises(VerdictRefuted, match=r"the sums of schedule .* contradict its games: .*game_digests of 0"):
        verify(row.id, registry=registry)
    ledger = Ledger(registry)
    ledger.recount(ledger.schedule(row.schedule))
    verify(row.id, registry=registry)
    with pytest.raises(VerdictRefuted, match="cannot be replayed"):
        verify(row.id, registry=registry, replays=2)


def test_a_changed_environment_is_named_as_the_cause(registry: Registry) -> None:
    """The moves stand for a changed `step`: either way the game does not end as recorded."""
    row = verdicts(registry)[0]
    change_moves(registry, row.id, shorten)
    league = registry.leagues.get(tictactoe.LEAGUE)
    environment = league.config.environment.model_copy(update={"revision": "2"})
    registry.leagues.register(league.config.model_copy(update={"environment": environment}), league.interface)
    with pytest.raises(VerdictRefuted, match=r"cannot be replayed.*the environment has changed since then"):
        verify(row.id, registry=registry, replays=2)


def test_only_closed_verdicts_can_be_verified_and_a_void_one_as_far_as_it_was_tested(tmp_path: Path) -> None:
    registry = league_of(tmp_path, STRONG, WEAK)
    with pytest.raises(NotFound, match="no verdict 'x'"):
        verify("x", registry=registry)
    verdict = open_verdict(registry, registry.leagues.get(tictactoe.LEAGUE), 2, "script:random")
    with pytest.raises(InvalidInput, match="is still open"):
        verify(verdict.id, registry=registry)
    assert conclude(promote(registry, 1), verdict).outcome == "void"
    assert verify(verdict.id, registry=registry).outcome == "void"


def test_a_verdict_with_forfeits_is_verified(tmp_path: Path) -> None:
    registry = league_of(tmp_path, STRONG, illegal_action_graph(crashes=True))
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
    with pytest.raises(VerdictRefuted, match="which did not have to act then"):
        verify(row.id, registry=registry, replays=8)
