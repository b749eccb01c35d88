"""What the registry is told of a run, whatever becomes of the run and of the registry."""

import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from league.errors import ParityError
from league.registry import runs
from league.registry.registry import Registry
from league.registry.rows import RunRow
from league.settings import Storage
from tests.evaluation.waiting import until
from tests.league.registry.examples import interface
from tests.training.leagues import tictactoe
from training import chronicle
from training.chronicle import Chronicle
from training.interrupts import Interrupted
from training.runs import Run

LEAGUE = tictactoe(steps=1000, lr=0.01)


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    monkeypatch.setattr(chronicle, "AGAIN", 0.01)
    opened = Registry.open(Storage.at(tmp_path / "home"))
    opened.register(LEAGUE, interface())
    yield opened
    opened.close()


@pytest.fixture
def run(registry: Registry) -> Run:
    return Run.begin(registry.storage, LEAGUE, 3, None)


def told(registry: Registry, run: Run) -> RunRow:
    return registry.run("tictactoe", run.id)


def result(steps: int, **curves: object) -> dict[str, object]:
    """As Tune gives it, with its own bookkeeping."""
    return {
        "steps": steps,
        "seconds": steps / 10,
        "timesteps_total": 5000 + steps,
        "training_iteration": 1,
        "pid": 7,
        "date": "today",
        "done": False,
        "config": {"lr": 1},
        "agents/player_1/return": 0.5,
    } | curves


def drive(registry: Registry, run: Run, reports: list[int], end: BaseException) -> None:
    """Training that reports after so many steps, each time when the last report was heard."""
    with Chronicle(registry, run) as telling:
        telling.begin(0, 0.0)
        until(lambda: registry.run_counts() == {"tictactoe": 1})
        for steps in reports:
            telling.tell(result(steps, loss=1.0))
            until(lambda steps=steps: told(registry, run).steps == steps)
        raise end


def test_what_is_trained_and_each_point_of_its_curves(registry: Registry, run: Run) -> None:
    with Chronicle(registry, run) as telling:
        telling.begin(0, 0.0)
        until(lambda: registry.run_counts() == {"tictactoe": 1})
        begun = told(registry, run)
        assert (begun.algorithm, begun.seed, begun.target, begun.parent) == ("ppo", 5, 1000, 3)
        assert (begun.settings["lr"], begun.settings["hidden"]) == (0.01, [16])
        for steps in (100, 200):
            telling.tell(result(steps, **{"shared/return": steps / 3e3, "shared/kl": float("nan")}))
            until(lambda steps=steps: told(registry, run).steps == steps)
    row = told(registry, run)
    assert (row.state, row.error, row.lives, row.seconds) == ("ended", None, 1, 20.0)
    points = registry.run_points("tictactoe", run.id)
    assert [(point.steps, point.curves) for point in points] == [
        (100, {"shared/return": 0.0333333}),
        (200, {"shared/return": 0.0666667}),
    ]


def test_what_comes_faster_than_it_is_taken_is_told_as_one(
    registry: Registry, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes_on, record = threading.Event(), registry.record_point

    def slowly(*arguments: object) -> None:
        goes_on.wait(60)
        record(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(registry, "record_point", slowly)
    with Chronicle(registry, run) as telling:
        telling.begin(0, 0.0)
        until(lambda: registry.run_counts() == {"tictactoe": 1})
        telling.tell(result(100, **{"return": 1.0, "loss": 0.5}))
        telling.tell(result(200, **{"return": 2.0}))
        goes_on.set()
    points = registry.run_points("tictactoe", run.id)
    assert [(point.steps, point.curves) for point in points] == [(200, {"return": 2.0, "loss": 0.5})]


@pytest.mark.parametrize(
    ("error", "state", "said"),
    [
        (ParityError("the graph differs"), "failed", "the graph differs"),
        (ZeroDivisionError("by\nzero"), "failed", "ZeroDivisionError: by zero"),
        (Interrupted("Ended early."), "stopped", None),
        (KeyboardInterrupt(), "stopped", None),
    ],
)
def test_how_it_ended(registry: Registry, run: Run, error: BaseException, state: str, said: str | None) -> None:
    with pytest.raises(type(error)):
        drive(registry, run, [100], error)
    row = told(registry, run)
    assert (row.state, row.error, row.steps) == (state, said, 100)


def test_a_run_that_is_gone_on_with_keeps_its_record(registry: Registry, run: Run) -> None:
    with pytest.raises(KeyboardInterrupt):
        drive(registry, run, [100, 200, 300], KeyboardInterrupt())
    again = Run.resume(registry.storage, LEAGUE.with_training(steps=2000))
    with Chronicle(registry, again) as telling:
        telling.begin(200, 20.0)
        telling.tell(result(250, loss=0.5))
    (row,) = registry.runs("tictactoe")
    assert (row.id, row.state, row.lives, row.target) == (run.id, "ended", 2, 2000)
    assert [point.steps for point in registry.run_points("tictactoe", run.id)] == [100, 200, 250]


def test_it_lives_while_nothing_is_new(registry: Registry, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    assert runs.SILENT.total_seconds() > 3 * chronicle.BEAT
    monkeypatch.setattr(chronicle, "BEAT", 0.01)
    with Chronicle(registry, run) as telling:
        telling.begin(0, 0.0)
        until(lambda: registry.run_counts() == {"tictactoe": 1})
        first = told(registry, run).heartbeat_at
        until(lambda: told(registry, run).heartbeat_at > first)


def test_a_registry_that_is_away_for_a_while_ends_nothing(
    registry: Registry, run: Run, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chronicle, "BEAT", 0.01)
    database = registry.storage.home / "league.db"
    away = database.rename(database.with_name("away.db"))
    with caplog.at_level(logging.WARNING), Chronicle(registry, run) as telling:
        telling.begin(0, 0.0)
        telling.tell(result(100, loss=1.0))
        until(lambda: "hears nothing of training run" in caplog.text)
        away.rename(database)
        until(lambda: registry.run_counts() == {"tictactoe": 1})
        away = database.rename(database.with_name("away.db"))
        telling.tell(result(200, loss=0.5))
        until(lambda: caplog.text.count("hears nothing") == 2)
        away.rename(database)
    row = told(registry, run)
    assert (row.state, row.steps) == ("ended", 200)


def test_one_that_never_comes_back_is_waited_for_no_longer_than_can_be_borne(
    registry: Registry, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chronicle, "LAST_WORDS", 0.05)
    database = registry.storage.home / "league.db"
    away = database.rename(database.with_name("away.db"))
    with Chronicle(registry, run) as telling:
        telling.begin(0, 0.0)
    until(lambda: not any(thread.name == "chronicle" for thread in threading.enumerate()))
    away.rename(database)
    assert registry.runs("tictactoe") == []


def test_of_a_run_that_never_began_nothing_is_told(registry: Registry, run: Run) -> None:
    with pytest.raises(ParityError), Chronicle(registry, run):
        raise ParityError("before training")
    assert registry.runs("tictactoe") == []
