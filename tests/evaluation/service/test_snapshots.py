"""Snapshots equal the report of the league, and are recomputed only after changes."""

import json
import logging
import shutil
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from evaluation.gating.verdicts import open_verdict, void
from evaluation.matches.tournament import evaluate
from evaluation.reporting.league_report import LeagueReport, league_report
from evaluation.service import snapshots
from evaluation.service.snapshots import documents, refresh, thinned
from league.environments.building import interface
from league.errors import AlreadyRunning, UnknownLeague
from league.registry.registry import Registry
from league.registry.storage.rows import SnapshotRow
from league.settings import Storage
from tests.support.leagues import reported_league, tictactoe
from tests.support.leagues.tictactoe import LEAGUE

PARTS = {"summary", "leaderboard", "payoff", "ratings"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A league after a nightly run, with its snapshots."""
    home = tmp_path_factory.mktemp("home")
    with reported_league.league_after_nightly(home) as opened:
        refresh(opened, LEAGUE)
    return home


@pytest.fixture(scope="module")
def report(home: Path) -> LeagueReport:
    registry = Registry.open(Storage.at(home))
    result = league_report(registry, LEAGUE, pictures=False)
    registry.close()
    return result


@pytest.fixture
def registry(home: Path, tmp_path: Path) -> Iterator[Registry]:
    """A copy of the league that a test may change."""
    opened = Registry.open(Storage.at(Path(shutil.copytree(home, tmp_path / "home"))))
    yield opened
    opened.close()


def snapshot(registry: Registry, part: str) -> SnapshotRow:
    row = registry.snapshots.get(LEAGUE, part)
    assert row is not None
    return row


def times(registry: Registry) -> dict[str, datetime]:
    return {part: snapshot(registry, part).at for part in registry.snapshots.marks(LEAGUE)}


def test_snapshots_equal_the_report(registry: Registry, report: LeagueReport) -> None:
    expected = json.loads(json.dumps(report.to_json()))
    assert snapshot(registry, "summary").document == {
        "games": report.games,
        "matches": report.games // 2,
        "unique_games": report.unique_games,
        "scoring": "game",
        "actions": "greedy",
        "sides": ["player_1", "player_2"],
        "environment": "pettingzoo.classic.tictactoe_v3",
        "environment_digest": report.environment_digest,
        "earlier": [],
    }
    assert snapshot(registry, "leaderboard").document == {
        "sides": ["player_1", "player_2"],
        "leaderboard": expected["leaderboard"],
        "by_side": {},
        "not_champion": expected["not_champion"],
    }
    assert snapshot(registry, "payoff").document == expected["payoff"]
    assert snapshot(registry, "ratings").document == {"versions": expected["versions"]}
    assert registry.snapshots.marks(LEAGUE).keys() == PARTS | {
        f"verdict/{verdict.verdict}" for verdict in report.verdicts
    }
    for verdict in expected["verdicts"]:
        verdict["curve"] = [[block, llr] for block, llr in enumerate(verdict["curve"], start=1)]
        assert snapshot(registry, f"verdict/{verdict['verdict']}").document == verdict


def test_a_rollback_changes_why_the_best_version_is_not_champion_as_in_the_report(registry: Registry) -> None:
    assert snapshot(registry, "leaderboard").document["not_champion"] is None
    registry.aliases.rollback(LEAGUE, actor="ada", reason="it was slow")
    refresh(registry, LEAGUE)
    explanation = snapshot(registry, "leaderboard").document["not_champion"]
    assert "it was rolled back" in explanation
    assert explanation == league_report(registry, LEAGUE, pictures=False).not_champion


def test_current_snapshots_are_not_recomputed(registry: Registry) -> None:
    times_before = times(registry)
    assert registry.snapshots.stale() == []
    refresh(registry, LEAGUE)
    assert times(registry) == times_before


def test_new_games_change_the_standings_but_not_closed_verdicts(registry: Registry) -> None:
    times_before, games = times(registry), snapshot(registry, "summary").document["games"]
    played = evaluate(LEAGUE, ["tictactoe@1", "script:random"], registry=registry, blocks=4, seed=9)
    assert registry.snapshots.stale() == [LEAGUE]
    refresh(registry, LEAGUE)
    times_after = times(registry)
    assert registry.snapshots.stale() == []
    assert {part for part in times_after if times_after[part] != times_before[part]} == PARTS
    assert snapshot(registry, "summary").document["games"] == games + played.games


def test_a_verdict_is_recomputed_until_it_is_closed_and_when_voided(registry: Registry) -> None:
    verdict = open_verdict(registry, registry.leagues.get(LEAGUE), 1, "tictactoe@3", alpha=0.001)
    part = f"verdict/{verdict.id}"
    refresh(registry, LEAGUE)
    opened = snapshot(registry, part)
    assert (opened.document["outcome"], opened.document["curve"]) == ("open", [])
    registry.verdicts.close(verdict.id, "inconclusive", {"note": "nobody has played"})
    refresh(registry, LEAGUE)
    closed = snapshot(registry, part)
    assert (closed.document["outcome"], closed.document["reason"]) == (
        "inconclusive",
        "Inconclusive: nobody has played.",
    )
    void(registry, verdict.id, actor="ada", reason="a mistake")
    refresh(registry, LEAGUE)
    voided = snapshot(registry, part).document
    assert (voided["outcome"], voided["reason"]) == ("void", "Void: voided by ada: a mistake.")


def test_purged_games_are_ignored(registry: Registry) -> None:
    games, verdict = snapshot(registry, "summary").document["games"], registry.verdicts.all(LEAGUE)[0]
    void(registry, verdict.id, actor="ada", reason="another machine's", purge=True)
    refresh(registry, LEAGUE)
    summary = snapshot(registry, "summary").document
    report = league_report(registry, LEAGUE, pictures=False)
    assert summary["games"] == report.games < games
    assert snapshot(registry, f"verdict/{verdict.id}").document["outcome"] == "void"


def test_games_of_another_environment_are_ignored(registry: Registry) -> None:
    changed = tictactoe.config(environment={"entry_point": "tests.support.environments.hanging:Raising"})
    registry.leagues.register(changed, registry.leagues.get(LEAGUE).interface)
    assert registry.snapshots.stale() == [LEAGUE]
    refresh(registry, LEAGUE)
    summary = snapshot(registry, "summary").document
    assert (summary["games"], summary["environment"]) == (0, "tests.support.environments.hanging:Raising")
    assert snapshot(registry, "leaderboard").document["leaderboard"] == []
    assert snapshot(registry, "payoff").document is None
    assert [version["rating"] for version in snapshot(registry, "ratings").document["versions"]] == [None] * 3


def test_a_league_without_matches_has_all_parts(tmp_path: Path) -> None:
    with reported_league.empty(tmp_path) as registry:
        assert registry.snapshots.stale() == [LEAGUE]
        refresh(registry, LEAGUE)
        assert registry.snapshots.marks(LEAGUE).keys() == PARTS
        assert registry.snapshots.stale() == []
        assert snapshot(registry, "ratings").document == {"versions": []}
        with pytest.raises(UnknownLeague, match="chess"):
            refresh(registry, "chess")


def test_different_sides_have_their_own_standings(tmp_path: Path) -> None:
    with reported_league.league_with_roles(tmp_path) as registry:
        found = documents(registry, LEAGUE)
    assert found["summary"]["scoring"] == "side"
    assert list(found["leaderboard"]["by_side"]) == ["adversary", "good"]
    assert {standing["games"] for standing in found["leaderboard"]["by_side"]["good"]} == {10}


def test_the_longest_waiting_leagues_are_refreshed_first(registry: Registry) -> None:
    for name in ("never", "long-ago", "up-to-date"):
        config = tictactoe.config(league=name)
        registry.leagues.register(config, interface(config))
    registry.snapshots.put("long-ago", {"summary": {}}, mark="of another time")
    registry.snapshots.put("up-to-date", {"summary": {}}, mark=registry.snapshots.current_marks()["up-to-date"])
    registry.snapshots.put(LEAGUE, {"summary": {}}, mark="of another time")
    assert registry.snapshots.stale() == ["never", "long-ago", LEAGUE]


def test_a_league_is_refreshed_by_one_process_at_a_time(registry: Registry) -> None:
    other = Registry.open(registry.storage)
    with other.exclusive_lock(f"snapshots-{LEAGUE}"), pytest.raises(AlreadyRunning):
        refresh(registry, LEAGUE)
    other.close()


def test_an_aborted_refresh_keeps_the_previous_snapshots(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    previous = {part: snapshot(registry, part) for part in registry.snapshots.marks(LEAGUE)}
    registry.aliases.rollback(LEAGUE, actor="ada", reason="test")

    def abort(*_: object) -> Any:
        raise SystemExit("power cut")

    monkeypatch.setattr(snapshots, "rated_version", abort)
    with pytest.raises(SystemExit):
        refresh(registry, LEAGUE)
    assert {part: snapshot(registry, part) for part in registry.snapshots.marks(LEAGUE)} == previous
    assert registry.snapshots.stale() == [LEAGUE]
    monkeypatch.undo()
    refresh(registry, LEAGUE)
    assert registry.snapshots.stale() == []


def test_a_failing_verdict_does_not_affect_the_others(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with reported_league.empty(tmp_path) as registry:
        tictactoe.publish(registry, tictactoe.graph())
        first, second = (
            open_verdict(registry, registry.leagues.get(LEAGUE), 1, "script:random"),
            open_verdict(registry, registry.leagues.get(LEAGUE), 1, "script:one_ply"),
        )
        compute_evidence = snapshots.verdict_evidence

        def fail_for_second(registry: Registry, verdict: Any, events: Any) -> Any:
            if verdict.id == second.id:
                raise ZeroDivisionError
            return compute_evidence(registry, verdict, events)

        monkeypatch.setattr(snapshots, "verdict_evidence", fail_for_second)
        with caplog.at_level(logging.ERROR):
            refresh(registry, LEAGUE)
        assert registry.snapshots.marks(LEAGUE).keys() == PARTS | {f"verdict/{first.id}"}
    assert f"verdict {second.id} has no snapshot" in caplog.text


@pytest.mark.parametrize("blocks", [0, 1, 7, 8, 9, 10, 1000])
def test_a_curve_is_thinned_to_a_limited_number_of_points(blocks: int) -> None:
    curve = [block / 2 for block in range(1, blocks + 1)]
    points = thinned(curve, most=8)
    assert len(points) == min(blocks, 8)
    assert all(llr == block / 2 for block, llr in points)
    assert [block for block, _ in points] == sorted({block for block, _ in points})
    if blocks:
        assert (points[0][0], points[-1][0]) == (1, blocks)
