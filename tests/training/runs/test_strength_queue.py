"""Checkpoints are published in order beside training, and versions are measured; an interruption loses nothing."""

import io
import threading
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from league.config.league import LeagueConfig
from league.errors import ArtifactCorrupt, GameHung, LeagueError
from league.registry.registry import Registry
from league.registry.storage.rows import StrengthRow, VersionRow
from tests.support.leagues.registries import LEAGUE, publish
from tests.support.leagues.training_leagues import tictactoe
from training.runs import publish_queue
from training.runs.checkpoint_digests import write_digests
from training.runs.progress import TrainingProgress
from training.runs.publish_queue import PublishQueue
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
        scores: dict[str, Any] = {"games": games, "score": 0.75, "low": 0.5, "high": 0.875, "at": datetime.now(UTC)}
        identity: dict[str, Any] = {"league": version.league, "version": version.number, "run": version.run}
        return [StrengthRow(**identity, **scores, opponent="script:random", steps=100 * version.number)]

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
        points = events.Scalars(f"strength/script_random/{name}")
        assert [(point.step, point.value) for point in points] == [(100, value), (300, value)]


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


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Versions of the run, with `parent` as passed to `publish`. A checkpoint named 666 cannot be exported."""
    versions: list[Any] = []

    def publish(checkpoint: Any, *, parent: int | None, **_: Any) -> Any:
        if checkpoint.steps == 666:
            raise RuntimeError("signal only works in main thread")
        versions.append(SimpleNamespace(number=len(versions) + 1, steps=checkpoint.steps, parent=parent))
        return versions[-1]

    monkeypatch.setattr(publish_queue, "publish", publish)
    monkeypatch.setattr(publish_queue, "published_versions", lambda *_: list(versions))
    return versions


def queue_of(path: Path, parent: int | None = None) -> PublishQueue:
    config = SimpleNamespace(league="a")
    record = SimpleNamespace(config=config, parent=parent, git_commit=None, exploits=None)
    run: Any = SimpleNamespace(id="run", path=path, record=record)
    unused: Any = None
    return PublishQueue(run, unused, unused, announce=lambda row: None)


def checkpoints(directory: Path, *steps: int) -> list[Path]:
    paths = [directory / str(number) for number in steps]
    for path in paths:
        path.mkdir()
        (path / "state.pkl").write_bytes(b"weights")
        write_digests(path)
    return paths


def test_each_version_has_the_one_before_as_its_parent(published: list[Any], tmp_path: Path) -> None:
    paths, queue = checkpoints(tmp_path, 512, 1024, 1536, 2048), queue_of(tmp_path, parent=7)
    for path in paths:
        queue.add(path)
    queue.join()
    assert [(version.steps, version.parent) for version in published] == [(512, 7), (1024, 1), (1536, 2), (2048, 3)]
    assert not any(path.exists() for path in paths), "published checkpoints are deleted"


def test_nothing_is_published_after_a_failure(published: list[Any], tmp_path: Path) -> None:
    """The environment plays before a version is published: its exception is one sentence, with its line."""
    paths, queue = checkpoints(tmp_path, 512, 666, 1024), queue_of(tmp_path)
    for path in paths:
        queue.add(path)
    message = rf"^league a: training failed with RuntimeError: signal only works in main thread at {__file__}:\d+; see"
    with pytest.raises(LeagueError, match=message):
        queue.join()
    assert "Traceback" in (tmp_path / "error.txt").read_text()
    assert [version.steps for version in published] == [512]
    assert [path.exists() for path in paths] == [False, True, True], "later checkpoints remain on disk"


def test_a_damaged_checkpoint_is_not_published(published: list[Any], tmp_path: Path) -> None:
    paths, queue = checkpoints(tmp_path, 512), queue_of(tmp_path)
    (paths[0] / "state.pkl").write_bytes(b"weight5")
    queue.add(paths[0])
    with pytest.raises(ArtifactCorrupt, match=r"512/state\.pkl was changed"):
        queue.join()
    assert published == []
