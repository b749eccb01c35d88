"""Training runs in the registry: begun, told of, ended, gone on with; a bounded number of points of each."""

from datetime import UTC, datetime, timedelta
from itertools import pairwise

import pytest
from sqlalchemy import update

from league.errors import InvalidInput, UnknownLeague, UnknownRun
from league.registry import runs
from league.registry.registry import Registry
from league.registry.rows import RunPoint, RunRow
from league.registry.runs import SILENT
from league.registry.tables import Run
from tests.league.registry.examples import LEAGUE

SETTINGS = {"algorithm": "ppo", "lr": 3e-4}


def begin(registry: Registry, run: str = "first", steps: int = 0, parent: int | None = None) -> RunRow:
    return registry.begin_run(
        LEAGUE, run, algorithm="ppo", settings=SETTINGS, seed=7, target=10_000, parent=parent, steps=steps
    )


def tell(registry: Registry, steps: int, run: str = "first", **curves: float) -> None:
    point = RunPoint(steps, curves or {"return": steps / 10}, datetime.now(UTC))
    registry.record_point(LEAGUE, run, point, seconds=steps / 100)


def steps_of(registry: Registry, run: str = "first") -> list[int]:
    return [point.steps for point in registry.run_points(LEAGUE, run)]


def falls_silent(registry: Registry) -> None:
    with registry.database.write() as session:
        session.execute(update(Run).values(heartbeat_at=datetime.now(UTC) - SILENT - timedelta(seconds=1)))


def test_a_run_begins_tells_and_ends(registry: Registry) -> None:
    begun = begin(registry)
    assert (begun.league, begun.id, begun.state, begun.lives) == (LEAGUE, "first", "running", 1)
    assert (begun.algorithm, begun.settings, begun.seed, begun.target) == ("ppo", SETTINGS, 7, 10_000)
    assert (begun.parent, begun.steps, begun.curves) == (None, 0, {})
    assert registry.run_counts() == {LEAGUE: 1}
    assert registry.run_points(LEAGUE, "first") == []
    tell(registry, 100, **{"return": 0.5, "shared/entropy": 1.5})
    tell(registry, 200, **{"return": 0.75})
    told = registry.run(LEAGUE, "first")
    assert (told.steps, told.seconds, told.curves) == (200, 2.0, {"return": 0.75, "shared/entropy": 1.5})
    points = registry.run_points(LEAGUE, "first")
    assert [(point.steps, point.curves) for point in points] == [
        (100, {"return": 0.5, "shared/entropy": 1.5}),
        (200, {"return": 0.75}),
    ]
    assert begun.began_at <= points[0].at <= points[1].at <= told.heartbeat_at
    registry.end_run(LEAGUE, "first", "ended")
    ended = registry.run(LEAGUE, "first")
    assert (ended.state, ended.error) == ("ended", None)
    assert ended.ended_at is not None
    assert registry.run_counts() == {}


def test_why_one_failed_is_kept(registry: Registry) -> None:
    begin(registry)
    registry.end_run(LEAGUE, "first", "failed", "the board is gone")
    row = registry.run(LEAGUE, "first")
    assert (row.state, row.error) == ("failed", "the board is gone")


def test_one_of_which_nothing_is_heard_is_silent_until_it_is_heard_again(registry: Registry) -> None:
    begin(registry)
    falls_silent(registry)
    assert registry.run(LEAGUE, "first").state == registry.runs(LEAGUE)[0].state == "silent"
    assert registry.run_counts() == {}
    registry.record_point(LEAGUE, "first", None)
    assert registry.run(LEAGUE, "first").state == "running"
    registry.end_run(LEAGUE, "first", "stopped")
    falls_silent(registry)
    assert registry.run(LEAGUE, "first").state == "stopped", "it has ended"


def test_one_that_goes_on_forgets_what_it_told_beyond_where_it_goes_on(registry: Registry) -> None:
    begun = begin(registry, parent=None)
    for steps in (100, 200, 300):
        tell(registry, steps)
    registry.end_run(LEAGUE, "first", "failed", "power cut")
    again = begin(registry, steps=200)
    assert (again.state, again.error, again.ended_at, again.lives) == ("running", None, None, 2)
    assert (again.steps, again.began_at) == (200, begun.began_at)
    assert steps_of(registry) == [100, 200]
    tell(registry, 250)
    assert steps_of(registry) == [100, 200, 250]


@pytest.mark.parametrize("jitter", [0, 3])
def test_points_are_spread_over_the_run_and_never_too_many(
    local: Registry, jitter: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "FULL", 21)
    begin(local)
    for number in range(150):
        newest = 10 * number + number % 2 * jitter
        tell(local, newest)
        kept = steps_of(local)
        assert len(kept) < 21
        assert (kept[0], kept[-1]) == (0, newest), "the first and the newest are always there"
    assert len(kept) >= 10
    gaps = {later - earlier for earlier, later in pairwise(kept[:-1])}
    assert max(gaps) <= 2 * min(gaps), f"no part of the run is told more finely than another: {gaps}"


def test_a_point_that_is_told_again_takes_the_place_of_the_first(registry: Registry) -> None:
    begin(registry)
    tell(registry, 100, loss=1.0)
    tell(registry, 100, loss=2.0)
    assert [(point.steps, point.curves) for point in registry.run_points(LEAGUE, "first")] == [(100, {"loss": 2.0})]


def test_they_are_listed_newest_first(registry: Registry) -> None:
    names = [f"run-{number}" for number in (3, 1, 4, 2)]
    for name in names:
        begin(registry, name)
    assert [row.id for row in registry.runs(LEAGUE)] == names[::-1]
    assert [row.id for row in registry.runs(LEAGUE, limit=2)] == names[:1:-1]
    assert [row.id for row in registry.runs(LEAGUE, before=names[2], limit=5)] == names[1::-1]
    with pytest.raises(InvalidInput, match="before: league tictactoe has no training run 'run-9'"):
        registry.runs(LEAGUE, before="run-9")


def test_what_is_not_there_is_named(registry: Registry) -> None:
    with pytest.raises(UnknownLeague, match="chess"):
        registry.begin_run("chess", "first", algorithm="ppo", settings={}, seed=0, target=1)
    for ask in (registry.run, registry.run_points, lambda *run: registry.end_run(*run, "ended")):
        with pytest.raises(UnknownRun, match="has no training run 'first'"):
            ask(LEAGUE, "first")
    with pytest.raises(UnknownLeague):
        registry.runs("chess")
