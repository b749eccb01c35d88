"""Training runs in the registry: their states, a limited number of points per run, the strength of their versions, and
nights of training.
"""

from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

import pytest

from league.errors import InvalidInput, UnknownRun
from league.registry.registry import Registry
from league.registry.storage.rows import RunPoint, RunRow, StrengthRow
from league.registry.training import runs
from tests.support.leagues.registries import LEAGUE, expire_heartbeats, publish, registered

SETTINGS = {"algorithm": "ppo", "lr": 3e-4}


def begin(registry: Registry, run: str = "first", steps: int = 0, parent: int | None = None) -> RunRow:
    return registry.runs.begin(
        LEAGUE, run, algorithm="ppo", settings=SETTINGS, seed=7, target=10_000, parent=parent, steps=steps
    )


def record(registry: Registry, steps: int, run: str = "first", **curves: float) -> None:
    point = RunPoint(LEAGUE, run, steps, curves or {"return": steps / 10}, datetime.now(UTC))
    registry.runs.record(LEAGUE, run, point, seconds=steps / 100)


def steps_of(registry: Registry, run: str = "first") -> list[int]:
    return [point.steps for point in registry.runs.points(LEAGUE, run)]


def test_a_run_begins_records_points_and_ends(registry: Registry) -> None:
    run = begin(registry)
    assert (run.league, run.id, run.state, run.attempts) == (LEAGUE, "first", "running", 1)
    assert (run.algorithm, run.settings, run.seed, run.target) == ("ppo", SETTINGS, 7, 10_000)
    assert (run.parent, run.steps, run.curves) == (None, 0, {})
    assert registry.runs.counts() == {LEAGUE: 1}
    assert registry.runs.points(LEAGUE, "first") == []
    record(registry, 100, **{"return": 0.5, "shared/entropy": 1.5})
    record(registry, 200, **{"return": 0.75})
    stored = registry.runs.get(LEAGUE, "first")
    assert (stored.steps, stored.seconds, stored.curves) == (200, 2.0, {"return": 0.75, "shared/entropy": 1.5})
    points = registry.runs.points(LEAGUE, "first")
    assert [(point.steps, point.curves) for point in points] == [
        (100, {"return": 0.5, "shared/entropy": 1.5}),
        (200, {"return": 0.75}),
    ]
    assert run.began_at <= points[0].at <= points[1].at <= stored.heartbeat_at
    registry.runs.end(LEAGUE, "first", "ended")
    ended = registry.runs.get(LEAGUE, "first")
    assert (ended.state, ended.error) == ("ended", None)
    assert ended.ended_at is not None
    assert registry.runs.counts() == {}


def test_a_run_without_heartbeat_is_silent_until_the_next_one(registry: Registry) -> None:
    begin(registry)
    expire_heartbeats(registry, RunRow)
    assert registry.runs.get(LEAGUE, "first").state == registry.runs.newest(LEAGUE)[0].state == "silent"
    assert registry.runs.counts() == {}
    registry.runs.record(LEAGUE, "first", None)
    assert registry.runs.get(LEAGUE, "first").state == "running"
    registry.runs.end(LEAGUE, "first", "stopped")
    expire_heartbeats(registry, RunRow)
    assert registry.runs.get(LEAGUE, "first").state == "stopped", "the run has ended"


def test_a_resumed_run_drops_the_points_after_its_checkpoint(registry: Registry) -> None:
    started = begin(registry, parent=None)
    for steps in (100, 200, 300):
        record(registry, steps)
    registry.runs.end(LEAGUE, "first", "failed", "power cut")
    row = registry.runs.get(LEAGUE, "first")
    assert (row.state, row.error) == ("failed", "power cut")
    resumed = begin(registry, steps=200)
    assert (resumed.state, resumed.error, resumed.ended_at, resumed.attempts) == ("running", None, None, 2)
    assert (resumed.steps, resumed.began_at) == (200, started.began_at)
    assert steps_of(registry) == [100, 200]
    for loss in (1.0, 2.0):  # a point that is recorded again replaces the first
        record(registry, 250, loss=loss)
    assert steps_of(registry) == [100, 200, 250]
    assert registry.runs.points(LEAGUE, "first")[-1].curves == {"loss": 2.0}


def test_points_are_spread_evenly_over_the_run(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "MAX_POINTS", 21)
    begin(registry)
    for number in range(100):
        newest = 10 * number + number % 2 * 3
        record(registry, newest)
        kept = steps_of(registry)
        assert len(kept) < 21
        assert (kept[0], kept[-1]) == (0, newest), "the first and the newest point are kept"
    assert len(kept) >= 10
    gaps = {later - earlier for earlier, later in pairwise(kept[:-1])}
    assert max(gaps) <= 2 * min(gaps), f"uneven gaps: {gaps}"


def test_runs_are_listed_newest_first(registry: Registry) -> None:
    names = [f"run-{number}" for number in (3, 1, 4, 2)]
    for name in names:
        begin(registry, name)
    assert [row.id for row in registry.runs.newest(LEAGUE)] == names[::-1]
    assert [row.id for row in registry.runs.newest(LEAGUE, limit=2)] == names[:1:-1]
    assert [row.id for row in registry.runs.newest(LEAGUE, before=names[2], limit=5)] == names[1::-1]
    with pytest.raises(InvalidInput, match="before: league tictactoe has no training run 'run-9'"):
        registry.runs.newest(LEAGUE, before="run-9")


def test_unknown_runs_are_reported(registry: Registry) -> None:
    for call in (registry.runs.get, registry.runs.points, lambda *run: registry.runs.end(*run, "ended")):
        with pytest.raises(UnknownRun, match="has no training run 'first'"):
            call(LEAGUE, "first")


def test_nights_are_numbered_within_their_league(registry: Registry) -> None:
    registered(registry, "chess")
    for league in (LEAGUE, "chess", LEAGUE):
        opened = registry.training_nights.open(league)
        assert registry.training_nights.open(league) == opened, "the night that is open"
        closed = registry.training_nights.close(opened.id)
        assert closed.number == opened.number
    nights = registry.training_nights.all(LEAGUE)
    assert [night.number for night in nights] == [1, 2]
    assert [night.id for night in nights] == [1, 3]
    assert closed == nights[-1]
    assert [night.number for night in registry.training_nights.all("chess")] == [1]


ROW = StrengthRow(
    league=LEAGUE,
    version=1,
    opponent="script:random",
    run="first",
    steps=512,
    games=200,
    score=0.75,
    low=0.68,
    high=0.81,
    at=datetime(2026, 11, 24, tzinfo=UTC),
)


def test_scores_are_read_by_run_in_the_order_of_the_versions(registry: Registry) -> None:
    for run in ("first/1", "first/2", "second/1"):
        publish(registry, run)
    later, other = replace(ROW, version=2, steps=1024), replace(ROW, version=3, run="second")
    for row in (later, ROW, other, replace(ROW, score=0.1)):
        registry.strength.record([row])
    assert registry.strength.of_run(LEAGUE, "first") == [ROW, later], "a repeated measurement keeps the first score"
    assert registry.strength.of_run(LEAGUE, "second") == [other]
    registry.strength.record([replace(other, opponent="script:one_ply")])
    assert len(registry.strength.of_run(LEAGUE, "second")) == 2
    assert registry.strength.of_run(LEAGUE, "third") == []
