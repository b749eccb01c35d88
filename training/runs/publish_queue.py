"""Publishes a run's checkpoints in order, in a thread beside training."""

import queue
import shutil
import threading
import traceback
from collections.abc import Callable
from pathlib import Path

import torch

from league.errors import LeagueError
from league.interface import Interface
from league.registry.registry import Registry
from league.registry.storage.rows import VersionRow
from training.export.publish import Checkpoint, publish
from training.runs.checkpoint_digests import private_copy
from training.runs.error_messages import training_error
from training.runs.run_directory import RunDirectory


class PublishQueue:
    """A thread of the driver. A checkpoint is deleted once it is published: the version contains it.

    The first version of a run has the run's parent, each further one the version before it.
    """

    def __init__(
        self, run: RunDirectory, registry: Registry, interface: Interface, announce: Callable[[VersionRow], None]
    ) -> None:
        """announce: called with each version, in this thread."""
        self._run = run
        self._registry = registry
        self._interface = interface
        self._announce = announce
        self._queue: queue.Queue[Path] = queue.Queue()
        self._thread = threading.Thread(target=self._work, name="publisher", daemon=True)
        self._thread.start()
        self.error: LeagueError | None = None
        """The error that stopped publishing."""

    def add(self, checkpoint: Path) -> None:
        """Publish `checkpoint` after those added before it."""
        self._queue.put(checkpoint)

    def join(self) -> None:
        """Wait until all added checkpoints are published. Raises the first error; later checkpoints remain on disk."""
        self._queue.join()
        if self.error is not None:
            raise self.error

    def _work(self) -> None:
        torch.set_num_threads(1)  # training continues meanwhile and needs the cores
        while True:
            checkpoint = self._queue.get()
            try:
                if self.error is None:
                    self._publish(checkpoint)
            except LeagueError as error:
                self.error = error
            except BaseException as error:  # of the environment, which plays before a version is published
                trace = self._run.path / "error.txt"
                trace.write_text("".join(traceback.format_exception(error)))
                self.error = training_error(error, self._run.record.config.league, trace)
            finally:
                self._queue.task_done()

    def _publish(self, path: Path) -> None:
        before = published_versions(self._registry, self._run)
        copy = private_copy(path, path.with_name(f"{path.name}.copy"))
        row = publish(
            Checkpoint(copy, source=f"{self._run.id}/{path.name}", steps=int(path.name)),
            registry=self._registry,
            config=self._run.record.config,
            interface=self._interface,
            parent=before[-1].number if before else self._run.record.parent,
            exploits=self._run.record.exploits,
            git_commit=self._run.record.git_commit,
        )
        for directory in (path, copy):
            shutil.rmtree(directory)
        self._announce(row)


def published_versions(registry: Registry, run: RunDirectory) -> list[VersionRow]:
    """Return the versions that a run has published, ascending."""
    rows = registry.versions.all(run.record.config.league)
    return [row for row in rows if row.run == run.id]
