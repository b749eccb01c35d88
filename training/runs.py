"""What a training run leaves on disk, so that it can be gone on with.

<home>/runs/<league>/<run>/
    run.json            what is trained; written before training, and when it is complete
    lock                held while a driver works on it
    life-<n>/           Tune's trial and its TensorBoard files; a new life at each start
        checkpoints/<steps>/    RLlib's state, until it is published
"""

import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from filelock import FileLock, Timeout
from pydantic import BaseModel, ConfigDict

from league.config import LeagueConfig
from league.errors import AlreadyRunning, ConfigError, NotFound
from league.registry.faults import disk_faults
from league.settings import Storage

RUN_FILE = "run.json"
LIFE = "life-"
CHECKPOINTS = "checkpoints"
MAY_CHANGE = {"steps", "minutes", "checkpoint_every", "checkpoint_minutes", "runners"}
"""Training settings that a run may be resumed with other values of: they decide how long, not what is learned."""


class RunRecord(BaseModel):
    """The content of run.json."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    config: LeagueConfig
    parent: int | None
    git_commit: str | None
    started_at: datetime
    complete: bool = False


class Run:
    """One training run of a league."""

    def __init__(self, path: Path, record: RunRecord) -> None:
        self.path = path
        self.record = record

    @property
    def id(self) -> str:
        """Unique among all runs: the time that it began at, and a random part."""
        return self.path.name

    @classmethod
    def begin(cls, storage: Storage, config: LeagueConfig, parent: int | None, git_commit: str | None) -> Self:
        """Make the directory of a new run."""
        now = datetime.now(UTC)
        path = _runs(storage, config.league) / f"{now:%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"
        run = cls(path, RunRecord(config=config, parent=parent, git_commit=git_commit, started_at=now))
        with disk_faults(path):
            path.mkdir(parents=True)
            run._write()
        return run

    @classmethod
    def resume(cls, storage: Storage, config: LeagueConfig) -> Self:
        """The league's newest run, if it is not complete. Raises NotFound; ConfigError if `config` is another."""
        runs = _runs(storage, config.league)
        newest = max(runs.glob(f"*/{RUN_FILE}"), default=None)
        if newest is None:
            raise NotFound(f"league {config.league} has no training run in {runs}: there is nothing to resume")
        record = RunRecord.model_validate_json(newest.read_text())
        if record.complete:
            raise NotFound(f"training run {newest.parent.name} is complete: there is nothing to resume")
        if (changed := _changed(record.config, config)) is not None:
            raise ConfigError(
                f"{changed} has changed since training run {newest.parent.name} began, so that it cannot go on: "
                f"start a new one, with --from if it should build on a version"
            )
        run = cls(newest.parent, record.model_copy(update={"config": config}))
        run._write()
        return run

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other drivers off. Raises AlreadyRunning. A driver that dies lets go."""
        lock = FileLock(self.path / "lock", timeout=0)
        try:
            lock.acquire()
        except Timeout as error:
            raise AlreadyRunning(f"training run {self.id} is under way in another process") from error
        try:
            yield
        finally:
            lock.release()

    def lives(self) -> list[Path]:
        """The directories of the run's starts, oldest first."""
        return sorted(self.path.glob(f"{LIFE}*"), key=lambda life: int(life.name.removeprefix(LIFE)))

    def next_life(self) -> Path:
        """Where the next start will live."""
        last = max((int(life.name.removeprefix(LIFE)) for life in self.lives()), default=0)
        return self.path / f"{LIFE}{last + 1}"

    def checkpoints(self) -> list[Path]:
        """Whole checkpoints that are not published yet, by their steps."""
        found = self.path.glob(f"{LIFE}*/{CHECKPOINTS}/*")
        return sorted((path for path in found if path.name.isdigit()), key=lambda path: int(path.name))

    def forget_checkpoints(self) -> None:
        """Remove what earlier lives saved, and what they might still be saving: all that counts is published."""
        for life in self.lives():
            shutil.rmtree(life / CHECKPOINTS, ignore_errors=True)

    def complete(self) -> None:
        """Record that the budget is spent and all is published."""
        self.record = self.record.model_copy(update={"complete": True})
        self._write()

    def _write(self) -> None:
        draft = self.path / f".{RUN_FILE}"
        with draft.open("w") as file:
            file.write(self.record.model_dump_json(indent=2, by_alias=True))
            file.flush()
            os.fsync(file.fileno())
        draft.replace(self.path / RUN_FILE)


def _runs(storage: Storage, league: str) -> Path:
    return storage.home / "runs" / league


def _changed(old: LeagueConfig, new: LeagueConfig) -> str | None:
    """The first part that differs in what is learned."""
    for key in ("environment", "policies"):
        if getattr(old, key) != getattr(new, key):
            return key
    before, after = (json.loads(config.training.model_dump_json(by_alias=True)) for config in (old, new))
    for key in before.keys() | after.keys():
        if key not in MAY_CHANGE and before.get(key) != after.get(key):
            return f"training.{key}"
    return None
