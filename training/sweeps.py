"""What a sweep leaves on disk, so that it can be gone on with.

<home>/sweeps/<league>/<sweep>/
    sweep.json          what is tried; written before the first trial, and when it is complete
    lock                held while a driver works on it
    end                 made to ask the trials to save and end
    trial-<number>/     Tune's trial and its TensorBoard files
        outcome.json        what came of it; written when it is over
        checkpoints/<steps>/    RLlib's state, the newest alone; gone when the sweep is complete
"""

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
from training.pinning import with_pins
from training.records import locked, write
from training.runs import CHECKPOINTS, END, changed_part
from training.search import Settings, applied

SWEEP_FILE = "sweep.json"
OUTCOME_FILE = "outcome.json"


class SweepRecord(BaseModel):
    """The content of sweep.json. See RunRecord."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    config: LeagueConfig
    pins: dict[str, str]
    trials: tuple[Settings, ...]
    """The settings of each."""
    git_commit: str | None
    started_at: datetime
    complete: bool = False


class Outcome(BaseModel):
    """What came of a trial. score: the metric over its last reports; None if it never had one."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    score: float | None
    steps: int
    seconds: float
    ended_early: bool
    """By the scheduler, as others were better."""


class Sweep:
    """One sweep of a league."""

    def __init__(self, path: Path, record: SweepRecord) -> None:
        self.path = path
        self.record = record

    @property
    def id(self) -> str:
        """Unique among all sweeps and runs."""
        return f"sweep-{self.path.name}"

    @property
    def end(self) -> Path:
        return self.path / END

    @classmethod
    def begin(
        cls,
        storage: Storage,
        config: LeagueConfig,
        pins: dict[str, str],
        trials: list[Settings],
        git_commit: str | None,
    ) -> Self:
        """Make the directory of a new sweep. trials: the settings of each."""
        now = datetime.now(UTC)
        path = _sweeps(storage, config.league) / f"{now:%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"
        record = SweepRecord(
            config=with_pins(config, pins), pins=pins, trials=tuple(trials), git_commit=git_commit, started_at=now
        )
        with disk_faults(path):
            path.mkdir(parents=True)
            write(record, path / SWEEP_FILE)
        return cls(path, record)

    @classmethod
    def resume(cls, storage: Storage, config: LeagueConfig, trials: list[Settings]) -> Self:
        """The league's newest sweep, if it is not complete. Raises NotFound; ConfigError if `config` is another."""
        sweeps = _sweeps(storage, config.league)
        newest = max(sweeps.glob(f"*/{SWEEP_FILE}"), default=None)
        if newest is None:
            raise NotFound(f"league {config.league} has no sweep in {sweeps}: there is nothing to resume")
        record = SweepRecord.model_validate_json(newest.read_text())
        if record.complete:
            raise NotFound(f"sweep {newest.parent.name} is complete: there is nothing to resume")
        changed = changed_part(record.config, with_pins(config, record.pins))
        if changed is None and list(record.trials) != trials:
            changed = "sweep"
        if changed is not None:
            raise ConfigError(f"{changed} has changed since sweep {newest.parent.name} began: start a new one")
        return cls(newest.parent, record)

    def locked(self) -> AbstractContextManager[None]:
        """Keep other drivers off. Raises AlreadyRunning. A driver that dies lets go."""
        return locked(self.path, f"sweep {self.path.name}")

    def league(self, number: int) -> LeagueConfig:
        """The league as a trial trains it."""
        return applied(self.record.config, self.record.trials[number])

    def trial(self, number: int) -> Path:
        """The directory of a trial."""
        return self.path / f"trial-{number:03d}"

    def checkpoint(self, number: int) -> Path | None:
        """The newest whole checkpoint of a trial."""
        found = (path for path in (self.trial(number) / CHECKPOINTS).glob("*") if path.name.isdigit())
        return max(found, key=lambda path: int(path.name), default=None)

    def outcome(self, number: int) -> Outcome | None:
        """What came of a trial, if it is over."""
        file = self.trial(number) / OUTCOME_FILE
        return Outcome.model_validate_json(file.read_text()) if file.exists() else None

    def set_outcome(self, number: int, outcome: Outcome) -> None:
        """Record that a trial is over."""
        write(outcome, self.trial(number) / OUTCOME_FILE)

    def complete(self) -> None:
        """Record that all is done. The trials' checkpoints are no longer needed."""
        write(self.record.model_copy(update={"complete": True}), self.path / SWEEP_FILE)
        for number in range(len(self.record.trials)):
            shutil.rmtree(self.trial(number) / CHECKPOINTS, ignore_errors=True)


def _sweeps(storage: Storage, league: str) -> Path:
    return storage.home / "sweeps" / league
