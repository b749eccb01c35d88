"""What a training run leaves on disk, so that it can be gone on with.

<home>/runs/<league>/<run>/
    run.json            what is trained; written before training, and when it is complete
    lock                held while a driver works on it
    life-<n>/           Tune's trial and its TensorBoard files; a new life at each start
        end                 made to ask the trial to save and end
        checkpoints/<steps>/    RLlib's state, until it is published
"""

import json
import math
import secrets
import shutil
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict

from league.config import LeagueConfig
from league.errors import ConfigError, NotFound
from league.registry.faults import disk_faults
from league.settings import Storage
from league.training_config import TrainingSettings
from training.pinning import with_pins
from training.records import locked, write

RUN_FILE = "run.json"
LIFE = "life-"
CHECKPOINTS = "checkpoints"
END = "end"
MAY_CHANGE = {"steps", "minutes", "checkpoint_every", "checkpoint_minutes", "runners", "gpus", "runner_gpus", "crashes"}
"""Training settings that a run may be resumed with other values of: how long, and on what; not what is learned."""


class RunRecord(BaseModel):
    """The content of run.json."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    config: LeagueConfig
    """Its opponents are pinned."""
    pins: dict[str, str] = {}
    """Opponents as the user wrote them → what they were when the run began."""
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
    def begin(
        cls,
        storage: Storage,
        config: LeagueConfig,
        parent: int | None,
        git_commit: str | None,
        pins: dict[str, str] | None = None,
    ) -> Self:
        """Make the directory of a new run. pins: what the opponents' references mean."""
        pins = pins or {}
        config = with_pins(config, pins)
        now = datetime.now(UTC)
        path = _runs(storage, config.league) / f"{now:%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"
        run = cls(path, RunRecord(config=config, pins=pins, parent=parent, git_commit=git_commit, started_at=now))
        with disk_faults(path):
            path.mkdir(parents=True)
            run._write()
        return run

    @classmethod
    def resume(cls, storage: Storage, config: LeagueConfig) -> Self:
        """The league's newest run, if there is something left to do: it was interrupted, or its budget is larger now.

        Raises NotFound; ConfigError if `config` is another.
        """
        runs = _runs(storage, config.league)
        newest = max(runs.glob(f"*/{RUN_FILE}"), default=None)
        if newest is None:
            raise NotFound(f"league {config.league} has no training run in {runs}: there is nothing to resume")
        record = RunRecord.model_validate_json(newest.read_text())
        config = with_pins(config, record.pins)
        if (changed := changed_part(record.config, config)) is not None:
            raise ConfigError(
                f"{changed} has changed since training run {newest.parent.name} began, so that it cannot go on: "
                f"start a new one, with --from if it should build on a version"
            )
        if record.complete and not _has_larger_budget(record.config.training, config.training):
            raise NotFound(
                f"training run {newest.parent.name} is complete: there is nothing to resume, unless --steps or"
                " --minutes is larger"
            )
        run = cls(newest.parent, record.model_copy(update={"config": config, "complete": False}))
        run._write()
        return run

    def locked(self) -> AbstractContextManager[None]:
        """Keep other drivers off. Raises AlreadyRunning. A driver that dies lets go."""
        return locked(self.path, f"training run {self.id}")

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
        write(self.record, self.path / RUN_FILE)


def _runs(storage: Storage, league: str) -> Path:
    return storage.home / "runs" / league


def changed_part(old: LeagueConfig, new: LeagueConfig) -> str | None:
    """The first part that differs in what is learned."""
    for key in ("environment", "policies"):
        if getattr(old, key) != getattr(new, key):
            return key
    before, after = (json.loads(config.training.model_dump_json(by_alias=True)) for config in (old, new))
    for key in before.keys() | after.keys():
        if key not in MAY_CHANGE and before.get(key) != after.get(key):
            return f"training.{key}"
    return None


def _has_larger_budget(old: TrainingSettings, new: TrainingSettings) -> bool:
    """Whether one limit is larger; the trial finds out whether the other one was what ended it."""
    before, now = (settings.minutes or math.inf for settings in (old, new))
    return new.steps > old.steps or now > before
