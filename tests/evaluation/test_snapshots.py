"""Snapshots say what the league's report says, and are computed again when something has changed, and only then."""

import json
import logging
import shutil
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from evaluation import snapshots
from evaluation.pages.league_report import LeagueReport, league_report
from evaluation.snapshots import documents, refresh, thinned
from evaluation.tournament import evaluate
from evaluation.verdicts import open_verdict, void
from league.environments.building import interface
from league.errors import AlreadyRunning, UnknownLeague
from league.registry.registry import Registry
from league.registry.rows import SnapshotRow
from league.settings import Storage
from tests.evaluation import examples
from tests.evaluation.examples import LEAGUE
from tests.evaluation.pages import leagues

PARTS = {"summary", "standings", "payoff", "ratings"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A league after a night, with its snapshots."""
    home = tmp_path_factory.mktemp("home")
    with leagues.of_a_night(home) as opened:
        refresh(opened, LEAGUE)
    return home


@pytest.fixture(scope="module")
def report(home: Path) -> LeagueReport:
    registry = Registry.open(Storage.at(home))
    told = league_report(registry, LEAGUE, pictures=False)
    registry.close()
    return told


@pytest.fixture
def registry(home: Path, tmp_path: Path) -> Iterator[Registry]:
    """The same league, to be changed."""
    opened = Registry.open(Storage.at(Path(shutil.copytree(home, tmp_path / "home"))))
    yield opened
    opened.close()


def snapshot(registry: Registry, part: str) -> SnapshotRow:
    row = registry.snapshot(LEAGUE, part)
    assert row is not None
    return row


def times(registry: Registry) -> dict[str, datetime]:
    return {part: snapshot(registry, part).at for part in registry.snapshot_marks(LEAGUE)}


def test_they_say_what_the_report_says(registry: Registry, report: LeagueReport) -> None:
    told = json.loads(json.dumps(report.to_json()))
    assert snapshot(registry, "summary").document == {
        "games": report.games,
        "matches": report.games // 2,
        "distinct_games": report.distinct_games,
        "scoring": "game",
        "sides": ["player_1", "player_2"],
        "environment": "pettingzoo.classic.tictactoe_v3",
        "environment_digest": report.environment_digest,
    }
    assert snapshot(registry, "standings").document == {
        "sides": ["player_1", "player_2"],
        "standings": told["standings"],
        "by_side": {},
    }
    assert snapshot(registry, "payoff").document == told["payoff"]
    assert snapshot(registry, "ratings").document == {"versions": told["versions"]}
    assert registry.snapshot_marks(LEAGUE).keys() == PARTS | {
        f"verdict/{verdict.verdict}" for verdict in report.verdicts
    }
    for verdict in told["verdicts"]:
        verdict["curve"] = [[block, llr] for block, llr in enumerate(verdict["curve"], start=1)]
        assert snapshot(registry, f"verdict/{verdict['verdict']}").document == verdict


def test_what_is_up_to_date_is_not_computed_again(registry: Registry) -> None:
    before = times(registry)
    assert registry.stale_snapshots() == []
    refresh(registry, LEAGUE)
    assert times(registry) == before


def test_new_games_change_the_standings_and_no_verdict_that_is_closed(registry: Registry) -> None:
    before, games = times(registry), snapshot(registry, "summary").document["games"]
    played = evaluate(LEAGUE, ["tictactoe@1", "script:random"], registry=registry, blocks=4, seed=9)
    assert registry.stale_snapshots() == [LEAGUE]
    refresh(registry, LEAGUE)
    after = times(registry)
    assert registry.stale_snapshots() == []
    assert {part for part in after if after[part] != before[part]} == PARTS
    assert snapshot(registry, "summary").document["games"] == games + played.games


def test_a_verdict_is_told_anew_until_it_is_closed_and_when_it_is_voided(registry: Registry) -> None:
    verdict = open_verdict(registry, registry.league(LEAGUE), 1, "tictactoe@3", alpha=0.001)
    part = f"verdict/{verdict.id}"
    refresh(registry, LEAGUE)
    opened = snapshot(registry, part)
    assert (opened.document["outcome"], opened.document["curve"]) == ("open", [])
    registry.close_verdict(verdict.id, "inconclusive", {"note": "nobody has played"})
    refresh(registry, LEAGUE)
    closed = snapshot(registry, part)
    assert (closed.document["outcome"], closed.document["reason"]) == ("inconclusive", "nobody has played")
    void(registry, verdict.id, actor="ada", reason="a mistake")
    refresh(registry, LEAGUE)
    voided = snapshot(registry, part).document
    assert (voided["outcome"], voided["reason"]) == ("void", "voided by ada: a mistake")


def test_games_that_were_purged_count_no_more(registry: Registry) -> None:
    games, judged = snapshot(registry, "summary").document["games"], registry.verdicts(LEAGUE)[0]
    void(registry, judged.id, actor="ada", reason="another machine's", purge=True)
    refresh(registry, LEAGUE)
    summary = snapshot(registry, "summary").document
    told = league_report(registry, LEAGUE, pictures=False)
    assert summary["games"] == told.games < games
    assert snapshot(registry, f"verdict/{judged.id}").document["outcome"] == "void"


def test_games_of_another_environment_count_no_more(registry: Registry) -> None:
    changed = examples.config(environment={"entry_point": "tests.evaluation.hanging:Raising"})
    registry.register(changed, registry.league(LEAGUE).interface)
    assert registry.stale_snapshots() == [LEAGUE]
    refresh(registry, LEAGUE)
    summary = snapshot(registry, "summary").document
    assert (summary["games"], summary["environment"]) == (0, "tests.evaluation.hanging:Raising")
    assert snapshot(registry, "standings").document["standings"] == []
    assert snapshot(registry, "payoff").document is None
    assert [version["rating"] for version in snapshot(registry, "ratings").document["versions"]] == [None] * 3


def test_a_league_without_matches_has_all_parts(tmp_path: Path) -> None:
    with leagues.empty(tmp_path) as registry:
        assert registry.stale_snapshots() == [LEAGUE]
        refresh(registry, LEAGUE)
        assert registry.snapshot_marks(LEAGUE).keys() == PARTS
        assert registry.stale_snapshots() == []
        assert snapshot(registry, "ratings").document == {"versions": []}
        with pytest.raises(UnknownLeague, match="chess"):
            refresh(registry, "chess")


def test_unlike_sides_have_standings_of_their_own(tmp_path: Path) -> None:
    with leagues.of_unlike_sides(tmp_path) as registry:
        told = documents(registry, LEAGUE)
    assert told["summary"]["scoring"] == "side"
    assert list(told["standings"]["by_side"]) == ["adversary", "good"]
    assert {standing["games"] for standing in told["standings"]["by_side"]["good"]} == {10}


def test_those_that_have_waited_longest_come_first(registry: Registry) -> None:
    for name in ("never", "long-ago", "up-to-date"):
        config = examples.config(league=name)
        registry.register(config, interface(config))
    registry.put_snapshots("long-ago", {"summary": {}}, mark="of another time")
    registry.put_snapshots("up-to-date", {"summary": {}}, mark=registry.marks()["up-to-date"])
    registry.put_snapshots(LEAGUE, {"summary": {}}, mark="of another time")
    assert registry.stale_snapshots() == ["never", "long-ago", LEAGUE]


def test_of_one_league_they_are_computed_once_at_a_time(registry: Registry) -> None:
    other = Registry.open(registry.storage)
    with other.alone(f"snapshots-{LEAGUE}"), pytest.raises(AlreadyRunning):
        refresh(registry, LEAGUE)
    other.close()


def test_what_breaks_off_leaves_the_snapshots_of_before(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {part: snapshot(registry, part) for part in registry.snapshot_marks(LEAGUE)}
    registry.rollback(LEAGUE, actor="ada", reason="test")

    def power_cut(*_: object) -> Any:
        raise SystemExit("power cut")

    monkeypatch.setattr(snapshots, "rated", power_cut)
    with pytest.raises(SystemExit):
        refresh(registry, LEAGUE)
    assert {part: snapshot(registry, part) for part in registry.snapshot_marks(LEAGUE)} == before
    assert registry.stale_snapshots() == [LEAGUE]
    monkeypatch.undo()
    refresh(registry, LEAGUE)
    assert registry.stale_snapshots() == []


def test_a_verdict_that_cannot_be_told_keeps_no_other_from_it(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with leagues.empty(tmp_path) as registry:
        examples.publish(registry, examples.graph())
        first, second = (
            open_verdict(registry, registry.league(LEAGUE), 1, "script:random"),
            open_verdict(registry, registry.league(LEAGUE), 1, "script:one_ply"),
        )
        judge = snapshots.judgement

        def fails_for_the_second(registry: Registry, verdict: Any, events: Any) -> Any:
            if verdict.id == second.id:
                raise ZeroDivisionError
            return judge(registry, verdict, events)

        monkeypatch.setattr(snapshots, "judgement", fails_for_the_second)
        with caplog.at_level(logging.ERROR):
            refresh(registry, LEAGUE)
        assert registry.snapshot_marks(LEAGUE).keys() == PARTS | {f"verdict/{first.id}"}
    assert f"verdict {second.id} has no snapshot" in caplog.text


@pytest.mark.parametrize("blocks", [0, 1, 7, 8, 9, 10, 1000])
def test_a_curve_is_told_by_a_bounded_number_of_its_points(blocks: int) -> None:
    curve = [block / 2 for block in range(1, blocks + 1)]
    kept = thinned(curve, most=8)
    assert len(kept) == min(blocks, 8)
    assert all(llr == block / 2 for block, llr in kept)
    assert [block for block, _ in kept] == sorted({block for block, _ in kept})
    if blocks:
        assert (kept[0][0], kept[-1][0]) == (1, blocks)
