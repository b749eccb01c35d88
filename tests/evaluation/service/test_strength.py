"""Strength during training: who plays a new version, with which seeds, what the scores say, and its process."""

import os
import signal
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from evaluation.matches.worker import MatchWorker
from evaluation.service import strength_worker
from evaluation.service.strength_process import StrengthProcess
from evaluation.service.strength_worker import measure_export, measure_strength, measured, opponents_of
from league.errors import LeagueError, UnknownVersion, WorkerLost
from league.policies.loading import strength_opponents
from league.registry.registry import Registry
from league.registry.storage.exports import exported_files, write_files
from league.results.ledger import Ledger
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import promote, reconfigure

GAMES = 40


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """A league with the versions 1 (weak), 2 (wins) and 3 (wins and blocks), without a champion."""
    with closing(tictactoe.registry(tmp_path / "home", play={"opening_plies": 2, "num_envs": 8})) as opened:
        for skills in ({}, {"wins": True}, {"wins": True, "blocks": True}):
            tictactoe.publish(opened, tictactoe.graph(**skills))
        yield opened


def opponents(registry: Registry, number: int) -> list[str]:
    return opponents_of(registry, registry.versions.get(tictactoe.LEAGUE, number))


def worker(registry: Registry) -> MatchWorker:
    return MatchWorker(registry.leagues.get(tictactoe.LEAGUE).config, registry)


def test_the_opponents_are_the_champion_and_an_anchor(registry: Registry) -> None:
    """Trials play the champion and all anchors, an exploiter its target, and no version itself."""
    assert opponents(registry, 3) == ["script:random"]
    promote(registry, 1)
    assert opponents(registry, 3) == ["tictactoe@1", "script:random"]
    assert opponents(registry, 1) == ["script:random"]
    reconfigure(registry, tictactoe.config(gate={"anchors": ["@1", "@staging", "script:one_ply", "@2"]}))
    assert opponents(registry, 3) == ["tictactoe@1", "script:one_ply"], "the champion and missing aliases are no anchor"
    assert opponents(registry, 1) == ["script:one_ply"]
    config = registry.leagues.get(tictactoe.LEAGUE).config
    assert strength_opponents(config, registry) == ["tictactoe@1", "script:one_ply", "tictactoe@2"]
    tictactoe.publish(registry, tictactoe.graph(wins=True), exploits="tictactoe@2")
    assert opponents(registry, 4) == ["tictactoe@2"]


def test_scores_have_intervals_and_are_repeated_exactly(registry: Registry, tmp_path: Path) -> None:
    """Also by exported files, which play as their version does."""
    promote(registry, 1)
    champion, anchor = rows = measure_strength(registry, worker(registry), 3, GAMES)
    assert (champion.version, champion.steps, champion.opponent, champion.games) == (3, 3, "tictactoe@1", GAMES)
    assert (anchor.opponent, anchor.games) == ("script:random", GAMES)
    assert all(0.5 < row.low < row.score <= row.high <= 1.0 for row in rows)
    again = measure_strength(registry, worker(registry), 3, GAMES)
    assert [(row.opponent, row.score) for row in again] == [(row.opponent, row.score) for row in rows]
    version = registry.versions.get(tictactoe.LEAGUE, 3)
    write_files(exported_files(version, registry.artifacts), tmp_path / "files")
    file = tmp_path / "files" / "manifest.json"
    file.write_text(version.manifest.model_copy(update={"version": 0}).to_json())
    scores = measure_export(worker(registry), tmp_path / "files", ["tictactoe@1", "script:random"], GAMES)
    assert [asdict(score) for score in scores] == [
        {name: getattr(row, name) for name in ("opponent", "games", "score", "low", "high")} for row in rows
    ]
    assert Ledger(registry).schedules(tictactoe.LEAGUE) == [], "the games are no results of the league"


def test_versions_play_the_same_openings(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[list[int]] = []
    play = MatchWorker.play

    def record(self: MatchWorker, *arguments: object, **options: object) -> list[object]:
        matches = play(self, *arguments, **options)  # type: ignore[arg-type]
        seeds.append([match.seed for match in matches])
        return matches  # type: ignore[return-value]

    monkeypatch.setattr(MatchWorker, "play", record)
    matches = worker(registry)
    for number in (2, 3):
        measure_strength(registry, matches, number, 4)
    assert seeds[0] == seeds[1]
    assert len(set(seeds[0])) == 2


def test_a_slow_environment_ends_the_matches_early(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strength_worker, "MOST_SECONDS", 0.0)
    (row,) = measure_strength(registry, worker(registry), 3, 1000)
    assert row.games == 8, "one chunk, with a game in each environment"


def process_id(measure: StrengthProcess) -> int:
    pid = measure._process.pid
    assert pid is not None
    return pid


def test_a_process_plays_reports_errors_and_is_replaced(registry: Registry) -> None:
    version = registry.versions.get(tictactoe.LEAGUE, 2)
    with closing(StrengthProcess(registry.storage)) as measure:
        (row,) = measure(version, 4)
        assert (row.version, row.opponent, row.games) == (2, "script:random", 4)
        first = process_id(measure)
        assert os.getpriority(os.PRIO_PROCESS, first) == 19
        with pytest.raises(UnknownVersion, match="tictactoe has no version 9"):
            measure(replace(version, number=9), 4)
        os.kill(first, signal.SIGKILL)
        with pytest.raises(WorkerLost, match="died"):
            measure(version, 4)
        assert measure(version, 4)[0].score == row.score
    with pytest.raises(WorkerLost, match="ended"):
        measure(version, 4)


def test_an_exception_of_a_policy_is_a_response(registry: Registry) -> None:
    """Its environment is closed, as after each measurement."""
    closed: list[bool] = []

    class Broken(MatchWorker):
        def contestant(self, ref: str) -> dict:
            raise RuntimeError("no such layer")

        def close_environment(self, expendable: bool = False) -> None:
            closed.append(True)

    broken = Broken(registry.leagues.get(tictactoe.LEAGUE).config, registry)
    with pytest.raises(LeagueError, match=r"^RuntimeError: no such layer$"):
        measured(registry, broken, {"version": 2, "games": 4})
    assert closed
