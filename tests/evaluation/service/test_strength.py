"""Strength during training: who plays a new version, with which seeds, and what the scores say."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

from evaluation.matches.worker import MatchWorker
from evaluation.service import strength_worker
from evaluation.service.strength_worker import measure_export, measure_strength, opponents_of
from league.policies.loading import strength_opponents
from league.registry.registry import Registry
from league.registry.storage.exports import exported_files, write_files
from league.results.ledger import Ledger
from tests.support.leagues import tictactoe

GAMES = 40


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """A league with the versions 1 (weak), 2 (wins) and 3 (wins and blocks), without a champion."""
    opened = tictactoe.registry(tmp_path / "home", play={"opening_plies": 2, "num_envs": 8})
    for skills in ({}, {"wins": True}, {"wins": True, "blocks": True}):
        tictactoe.publish(opened, tictactoe.graph(**skills))
    yield opened
    opened.close()


def opponents(registry: Registry, number: int) -> list[str]:
    return opponents_of(registry, registry.versions.get(tictactoe.LEAGUE, number))


def promote(registry: Registry, number: int) -> None:
    registry.aliases.set(tictactoe.LEAGUE, "champion", number, expected=None, actor="test", reason="first")


def configure(registry: Registry, *anchors: str) -> None:
    row = registry.leagues.get(tictactoe.LEAGUE)
    registry.leagues.register(tictactoe.config(gate={"anchors": anchors}), row.interface)


def worker(registry: Registry) -> MatchWorker:
    return MatchWorker(registry.leagues.get(tictactoe.LEAGUE).config, registry)


def test_the_opponents_are_the_champion_and_an_anchor(registry: Registry) -> None:
    assert opponents(registry, 3) == ["script:random"]
    promote(registry, 1)
    assert opponents(registry, 3) == ["tictactoe@1", "script:random"]
    assert opponents(registry, 1) == ["script:random"], "no version plays itself"
    configure(registry, "@1", "@staging", "script:one_ply")
    assert opponents(registry, 3) == ["tictactoe@1", "script:one_ply"], "the champion and missing aliases are no anchor"
    assert opponents(registry, 1) == ["script:one_ply"]


def test_trials_play_the_champion_and_all_anchors(registry: Registry) -> None:
    promote(registry, 1)
    configure(registry, "@1", "@2", "script:one_ply", "@2", "@staging")
    config = registry.leagues.get(tictactoe.LEAGUE).config
    assert strength_opponents(config, registry) == ["tictactoe@1", "tictactoe@2", "script:one_ply"]


def test_exported_files_play_as_their_version_does(registry: Registry, tmp_path: Path) -> None:
    version = registry.versions.get(tictactoe.LEAGUE, 3)
    write_files(exported_files(version, registry.artifacts), tmp_path / "files")
    file = tmp_path / "files" / "manifest.json"
    file.write_text(version.manifest.model_copy(update={"version": 0}).to_json())
    promote(registry, 1)
    opponents = ["tictactoe@1", "script:random"]
    scores = measure_export(worker(registry), tmp_path / "files", opponents, GAMES)
    rows = measure_strength(registry, worker(registry), 3, GAMES)
    assert [asdict(score) for score in scores] == [
        {name: getattr(row, name) for name in ("opponent", "games", "score", "low", "high")} for row in rows
    ]


def test_an_exploiter_plays_its_target(registry: Registry) -> None:
    promote(registry, 2)
    tictactoe.publish(registry, tictactoe.graph(wins=True), exploits="tictactoe@1")
    assert opponents(registry, 4) == ["tictactoe@1"]


def test_scores_have_intervals_and_are_repeated_exactly(registry: Registry) -> None:
    promote(registry, 1)
    champion, anchor = measure_strength(registry, worker(registry), 3, GAMES)
    assert (champion.version, champion.steps, champion.opponent, champion.games) == (3, 3, "tictactoe@1", GAMES)
    assert (anchor.opponent, anchor.games) == ("script:random", GAMES)
    for row in (champion, anchor):
        assert 0.5 < row.low < row.score <= row.high <= 1.0
    again = measure_strength(registry, worker(registry), 3, GAMES)
    assert [(row.opponent, row.score) for row in again] == [(row.opponent, row.score) for row in (champion, anchor)]
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
