"""Measures the strength of a run's versions, in a thread beside training.

The matches are played by whoever started the run, in another process of low priority (see `Measure`). An error costs
the scores of a version, never the run.
"""

import queue
import threading
from itertools import product
from types import TracebackType
from typing import Protocol, Self

from tensorboardX import SummaryWriter

from league.errors import LeagueError, one_line
from league.registry.registry import Registry
from league.registry.storage.rows import StrengthRow, VersionRow
from training.runs.progress import TrainingProgress
from training.runs.publish_queue import published_versions
from training.runs.run_directory import RunDirectory

STRENGTH = "strength"
"""The TensorBoard group, and the directory of its files in that of the run."""


class Measure(Protocol):
    """Plays a version against the champion and an anchor. Called from one thread."""

    def __call__(self, version: VersionRow, /, games: int) -> list[StrengthRow]:
        """Return one row per opponent, after at most `games` games against it. Raises LeagueError."""


class StrengthQueue:
    """A context manager: the end of the block discards the versions that are still waiting.

    They are measured when the run is resumed.
    """

    def __init__(
        self, run: RunDirectory, registry: Registry, progress: TrainingProgress, measure: Measure | None
    ) -> None:
        """measure: None measures nothing, as does `training.strength: null`."""
        config = run.record.config
        settings = config.training.strength
        # Matches would take simulators from training.
        is_measured = measure is not None and config.environment.external is None
        self._games = settings.games if settings is not None and is_measured else 0
        self._run, self._registry, self._progress, self._measure = run, registry, progress, measure
        self._queue: queue.Queue[VersionRow] = queue.Queue()
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, name="strength", daemon=True)

    def __enter__(self) -> Self:
        """Start with the versions that were published but not measured before an interruption."""
        if self._games:
            measured = {row.version for row in self._registry.strength.of_run(self._league, self._run.id)}
            for version in published_versions(self._registry, self._run):
                if version.number not in measured and version.retired_at is None:
                    self.add(version)
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._is_closed = True

    def add(self, version: VersionRow) -> None:
        """Measure a version after those added before it."""
        if self._games:
            self._queue.put(version)

    def join(self) -> None:
        """Wait until all added versions are measured."""
        if self._queue.unfinished_tasks:
            self._progress.say("Training is complete. Measuring the strength of the last versions; Ctrl-C skips this.")
        self._queue.join()

    @property
    def _league(self) -> str:
        return self._run.record.config.league

    def _work(self) -> None:
        while True:
            version = self._queue.get()
            try:
                if not self._is_closed:
                    assert self._measure is not None
                    rows = self._measure(version, games=self._games)
                    self._registry.strength.record(rows)
                    # The names of TensorBoard's files contain the time in seconds only.
                    directory, suffix = self._run.path / STRENGTH, f".{version.number}"
                    with SummaryWriter(str(directory), filename_suffix=suffix) as writer:
                        for row, name in product(rows, ("score", "low", "high")):
                            tag = f"{STRENGTH}/{row.opponent}/{name}"
                            writer.add_scalar(tag, getattr(row, name), global_step=row.steps)
                    self._progress.measured(version, rows)
            except Exception as error:  # a measurement must never end a run
                if not self._is_closed:
                    reason = one_line(error, with_type=not isinstance(error, LeagueError))
                    self._progress.say(f"The strength of {version.ref} was not measured: {reason}")
            finally:
                self._queue.task_done()
