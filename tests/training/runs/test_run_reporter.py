"""The training reports in the registry, for each ending of the run and with an unreachable registry."""

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from league.errors import ParityError
from league.registry.registry import Registry
from league.registry.storage import rows
from league.registry.storage.rows import RunRow
from tests.support.leagues.training_leagues import tictactoe
from tests.support.waiting import until
from training.runs import run_reporter
from training.runs.run_directory import RunDirectory
from training.runs.run_reporter import RunReporter
from training.runs.tune import Interrupted

LEAGUE = tictactoe(steps=1000, lr=0.01)


@pytest.fixture(autouse=True)
def intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_reporter, "RETRY_SECONDS", 0.01)
    monkeypatch.setattr(run_reporter, "FINAL_REPORT_SECONDS", 240.0)  # the machine may be busy


@pytest.fixture
def run(registry: Registry) -> RunDirectory:
    return RunDirectory.begin(registry.storage, LEAGUE, 3, None)


def recorded(registry: Registry, run: RunDirectory) -> RunRow:
    return registry.runs.get("tictactoe", run.id)


def result(steps: int, **curves: object) -> dict[str, object]:
    """A result of Tune, with its own fields."""
    of_tune = {"timesteps_total": 5000 + steps, "training_iteration": 1, "pid": 7, "date": "today", "done": False}
    of_agents = {"agents/player_1/return": 0.5, "agents/player_1/length": 5.0}
    return {"steps": steps, "seconds": steps / 10, "config": {"lr": 1}} | of_tune | of_agents | curves


@contextmanager
def reporting(registry: Registry, run: RunDirectory) -> Iterator[RunReporter]:
    """A reporter of a run that has begun."""
    with RunReporter(registry, run) as reporter:
        reporter.begin(0, 0.0)
        until(lambda: registry.runs.counts() == {"tictactoe": 1})
        yield reporter


def drive(registry: Registry, run: RunDirectory, reports: list[int], end: BaseException) -> None:
    """Training that reports at these steps, each time after the previous report was recorded."""
    with reporting(registry, run) as reporter:
        for steps in reports:
            reporter.report(result(steps, loss=1.0))
            until(lambda steps=steps: recorded(registry, run).steps == steps)
        raise end


def test_a_second_attempt_continues_the_record(
    registry: Registry, run: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first one got further than the version from which the second one continues."""
    monkeypatch.setattr(run_reporter, "HEARTBEAT_SECONDS", 0.01)
    with RunReporter(registry, run) as reporter:
        for start, reached in ((0, 300), (200, 250)):
            reporter.begin(start, start / 10)
            until(lambda start=start: registry.runs.counts() and recorded(registry, run).steps == start)
            reporter.report(result(reached, loss=1.0))
            until(lambda reached=reached: recorded(registry, run).steps == reached)
    row = recorded(registry, run)
    assert (row.attempts, row.steps, row.state) == (2, 250, "ended")


def test_settings_and_curves_are_recorded(registry: Registry, run: RunDirectory) -> None:
    with reporting(registry, run) as reporter:
        started = recorded(registry, run)
        assert (started.algorithm, started.seed, started.target, started.parent) == ("ppo", 5, 1000, 3)
        assert (started.settings["lr"], started.settings["hidden"]) == (0.01, [16])
        for steps in (100, 200):
            reporter.report(result(steps, **{"shared/return": steps / 3e3, "shared/kl": float("nan")}))
            until(lambda steps=steps: recorded(registry, run).steps == steps)
    row = recorded(registry, run)
    assert (row.state, row.error, row.attempts, row.seconds) == ("ended", None, 1, 20.0)
    points = registry.runs.points("tictactoe", run.id)
    assert [(point.steps, point.curves) for point in points] == [
        (100, {"shared/return": 0.0333333, "agents/player_1/return": 0.5}),
        (200, {"shared/return": 0.0666667, "agents/player_1/return": 0.5}),
    ]


def test_returns_of_many_agents_are_not_recorded(registry: Registry, run: RunDirectory) -> None:
    crowd = {f"agents/player_{number}/return": 0.5 for number in range(1, 10)}
    with RunReporter(registry, run) as reporter:
        reporter.begin(0, 0.0)
        reporter.report(result(100, loss=1.0, **crowd))
    assert recorded(registry, run).curves == {"loss": 1.0}


def test_reports_faster_than_the_registry_are_merged(
    registry: Registry, run: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    resume, record = threading.Event(), registry.runs.record

    def record_slowly(*arguments: object) -> None:
        resume.wait(60)
        record(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(registry.runs, "record", record_slowly)
    with reporting(registry, run) as reporter:
        reporter.report(result(100, **{"return": 1.0, "loss": 0.5}))
        reporter.report(result(200, **{"return": 2.0}))
        resume.set()
    points = registry.runs.points("tictactoe", run.id)
    assert [(point.steps, point.curves) for point in points] == [
        (200, {"return": 2.0, "loss": 0.5, "agents/player_1/return": 0.5})
    ]


@pytest.mark.parametrize(
    ("error", "state", "message"),
    [
        (ParityError("the graph differs"), "failed", "the graph differs"),
        (ZeroDivisionError("by\nzero"), "failed", "ZeroDivisionError: by zero"),
        (Interrupted("Ended early."), "stopped", None),
        (KeyboardInterrupt(), "stopped", None),
    ],
)
def test_the_ending_is_recorded(
    registry: Registry, run: RunDirectory, error: BaseException, state: str, message: str | None
) -> None:
    with pytest.raises(type(error)):
        drive(registry, run, [100], error)
    row = recorded(registry, run)
    assert (row.state, row.error, row.steps) == (state, message, 100)


def test_a_resumed_run_keeps_its_record(registry: Registry, run: RunDirectory) -> None:
    with pytest.raises(KeyboardInterrupt):
        drive(registry, run, [100, 200, 300], KeyboardInterrupt())
    resumed = RunDirectory.resume(registry, LEAGUE.with_training(steps=2000))
    with RunReporter(registry, resumed) as reporter:
        reporter.begin(200, 20.0)
        reporter.report(result(250, loss=0.5))
    (row,) = registry.runs.newest("tictactoe")
    assert (row.id, row.state, row.attempts, row.target) == (run.id, "ended", 2, 2000)
    assert [point.steps for point in registry.runs.points("tictactoe", run.id)] == [100, 200, 250]


def test_heartbeats_continue_without_new_reports(
    registry: Registry, run: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert rows.HEARTBEAT_TIMEOUT.total_seconds() > 3 * run_reporter.HEARTBEAT_SECONDS
    monkeypatch.setattr(run_reporter, "HEARTBEAT_SECONDS", 0.01)
    with reporting(registry, run):
        first = recorded(registry, run).heartbeat_at
        until(lambda: recorded(registry, run).heartbeat_at > first)


def test_training_survives_an_unreachable_registry(
    registry: Registry, run: RunDirectory, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_reporter, "HEARTBEAT_SECONDS", 0.01)
    database = registry.storage.home / "league.db"
    moved = database.rename(database.with_name("away.db"))
    with caplog.at_level(logging.WARNING), RunReporter(registry, run) as reporter:
        reporter.begin(0, 0.0)
        reporter.report(result(100, loss=1.0))
        until(lambda: "cannot report training run" in caplog.text)
        moved.rename(database)
        until(lambda: registry.runs.counts() and recorded(registry, run).steps == 100)
        moved = database.rename(database.with_name("away.db"))
        reporter.report(result(200, loss=0.5))
        until(lambda: caplog.text.count("cannot report") == 2)
        moved.rename(database)
    row = recorded(registry, run)
    assert (row.state, row.steps) == ("ended", 200)


def test_waiting_for_an_unreachable_registry_is_limited(
    registry: Registry, run: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_reporter, "FINAL_REPORT_SECONDS", 0.05)
    database = registry.storage.home / "league.db"
    moved = database.rename(database.with_name("away.db"))
    with RunReporter(registry, run) as reporter:
        reporter.begin(0, 0.0)
    until(lambda: not reporter._thread.is_alive())
    moved.rename(database)
    assert registry.runs.newest("tictactoe") == []


def test_a_run_that_never_started_is_not_recorded(registry: Registry, run: RunDirectory) -> None:
    with pytest.raises(ParityError), RunReporter(registry, run):
        raise ParityError("before training")
    assert registry.runs.newest("tictactoe") == []
