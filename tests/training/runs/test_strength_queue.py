"""Versions are measured in order beside training; errors do not end the run, and an interruption loses nothing."""

import io
import threading
from datetime import UTC, datetime

import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from league.config.league import LeagueConfig
from league.errors import GameHung
from league.registry.registry import Registry
from league.registry.storage.rows import StrengthRow, VersionRow
from tests.support.leagues.registries import LEAGUE, publish
from tests.support.leagues.training_leagues import tictactoe
from training.runs.progress import TrainingProgress
from training.runs.run_directory import RunDirectory
from training.runs.strength_queue import Measure, StrengthQueue


class Run:
    """A run, its versions, its output, and the versions that were measured."""

    def __init__(self, registry: Registry, config: LeagueConfig) -> None:
        self.registry = registry
        self.directory = RunDirectory.begin(registry.storage, config, None, None)
        self.output = io.StringIO()
        self.measured: list[tuple[int, int]] = []

    def queue(self, measure: Measure | None) -> StrengthQueue:
        progress = TrainingProgress(Console(file=self.output, width=200), tictactoe().training, ("shared",))
        return StrengthQueue(self.directory, self.registry, progress, measure)

    def publish(self, steps: int) -> VersionRow:
        return publish(self.registry, f"{self.directory.id}/{steps}")

    def measure(self, version: VersionRow, games: int) -> list[StrengthRow]:
        self.measured.append((version.number, games))
        if version.number == 2:
            raise GameHung("a game did not end")
        now = datetime.now(UTC)
        return [
            StrengthRow(
                league=version.league,
                version=version.number,
                opponent="script:random",
                run=version.run,
                steps=100 * version.number,
                games=games,
                score=0.75,
                low=0.5,
                high=0.875,
                at=now,
            )
        ]

    def recorded(self) -> list[tuple[int, str]]:
        return [(row.version, row.opponent) for row in self.registry.strength.of_run(LEAGUE, self.directory.id)]


def test_scores_are_recorded_shown_and_plotted(registry: Registry) -> None:
    run = Run(registry, tictactoe(strength={"games": 50}))
    with run.queue(run.measure) as queue:
        for steps in (100, 200, 300):
            queue.add(run.publish(steps))
        queue.join()
    assert run.measured == [(1, 50), (2, 50), (3, 50)]
    assert run.recorded() == [(1, "script:random"), (3, "script:random")]
    assert "75.0% [50.0%, 87.5%] against script:random (50 games)" in run.output.getvalue()
    assert "The strength of tictactoe@2 was not measured: a game did not end" in run.output.getvalue()
    events = EventAccumulator(str(run.directory.path / "strength"))
    events.Reload()
    for name, value in (("score", 0.75), ("low", 0.5), ("high", 0.875)):
        assert [(each.step, each.value) for each in events.Scalars(f"strength/script_random/{name}")] == [
            (100, value),
            (300, value),
        ]


def test_a_resumed_run_measures_what_was_not_measured(registry: Registry) -> None:
    run = Run(registry, tictactoe())
    first, second = threading.Event(), threading.Event()

    def slow(version: VersionRow, games: int) -> list[StrengthRow]:
        first.set()
        assert second.wait(60)
        return run.measure(version, games)

    one, three = run.publish(100), run.publish(200)
    with run.queue(slow) as interrupted:
        # Both were published by an earlier attempt, and therefore wait already.
        assert first.wait(60)
    second.set()
    interrupted.join()
    assert run.recorded() == [(1, "script:random")], "versions that waited are discarded"
    run.measured.clear()
    with run.queue(run.measure) as resumed:
        resumed.join()
    assert run.measured == [(three.number, 200)]
    assert one.number == 1


@pytest.mark.parametrize("strength", [None, {"games": 50}])
def test_nothing_is_measured_unless_it_is_wanted_and_possible(
    registry: Registry, strength: dict[str, int] | None
) -> None:
    run = Run(registry, tictactoe(strength=strength))
    version = run.publish(100)
    with run.queue(run.measure if strength is None else None) as queue:
        queue.add(version)
        queue.join()
    assert run.measured == []
    assert run.recorded() == []
