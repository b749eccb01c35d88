"""The directory of a sweep, from which it can be resumed.

<home>/sweeps/<league>/<sweep>/
    sweep.json          the sweep's trials; written before the first trial, before each that Optuna proposes, and on
                        completion
    lock                held while a driver works on the sweep
    stop                created to request that the trials save and end
    trial-<number>/     Tune's trial and its TensorBoard files
        outcome.json        the trial's result; written when it has ended
        checkpoints/<steps>/    RLlib's state, the newest only; deleted when the sweep is complete
"""

import secrets
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from league.config.league import LeagueConfig
from league.config.sweep import SweepConfig
from league.errors import ConfigError, NotFound
from league.files import disk_errors
from league.frozen import FrozenModel
from league.settings import Storage
from training.algorithms.resources import Resources
from training.runs.run_directory import CHECKPOINTS, STOP_FILE, changed_setting, locked, with_pins, write
from training.sweeps.search_space import Settings, TrialOutcome, applied, size

SWEEP_FILE = "sweep.json"
OUTCOME_FILE = "outcome.json"
SEARCH_SETTINGS = {"parameters", "search", "samples", "mode"}
"""Settings of `sweep` that decide what the trials are, and cannot change in a resumed sweep."""


class SweepRecord(FrozenModel):
    """The content of sweep.json. See RunRecord."""

    config: LeagueConfig
    pins: dict[str, str]
    trials: tuple[Settings, ...]
    """The settings of each trial; with Optuna, of those that have started."""
    resources: tuple[Settings, ...] = ()
    """What each trial uses in place of `auto`."""
    opponents: tuple[str, ...] = ()
    """Whom the strength of trials is measured against, as fixed references; empty with another metric."""
    git_commit: str | None
    started_at: datetime
    complete: bool = False


class SweepDirectory:
    """One sweep of a league."""

    def __init__(self, path: Path, record: SweepRecord) -> None:
        self.path = path
        self.record = record

    @property
    def id(self) -> str:
        """Unique among all sweeps and runs."""
        return f"sweep-{self.path.name}"

    @property
    def settings(self) -> SweepConfig:
        """The `sweep` section of the league."""
        assert self.record.config.sweep is not None
        return self.record.config.sweep

    @property
    def stop_file(self) -> Path:
        return self.path / STOP_FILE

    @classmethod
    def begin(
        cls,
        storage: Storage,
        config: LeagueConfig,
        pins: dict[str, str],
        trials: list[Settings],
        git_commit: str | None,
        opponents: Sequence[str] = (),
        resources: Sequence[Resources] = (),
    ) -> Self:
        """Create the directory of a new sweep. trials: the settings of each. Others: see `SweepRecord`."""
        started_at = datetime.now(UTC)
        path = _sweeps(storage, config.league) / f"{started_at:%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"
        record = SweepRecord(
            config=with_pins(config, pins),
            pins=pins,
            trials=tuple(trials),
            resources=tuple(used.settings for used in resources),
            opponents=tuple(opponents),
            git_commit=git_commit,
            started_at=started_at,
        )
        with disk_errors(path):
            path.mkdir(parents=True)
            write(record, path / SWEEP_FILE)
        return cls(path, record)

    @classmethod
    def resume(cls, storage: Storage, config: LeagueConfig) -> Self:
        """Open the league's newest sweep if it is incomplete. Raises NotFound; ConfigError if `config` differs."""
        sweeps = _sweeps(storage, config.league)
        newest = max(sweeps.glob(f"*/{SWEEP_FILE}"), default=None)
        if newest is None:
            raise NotFound(f"league {config.league} has no sweep in {sweeps}: there is nothing to resume")
        record = SweepRecord.model_validate_json(newest.read_text())
        if record.complete:
            raise NotFound(f"sweep {newest.parent.name} is complete: there is nothing to resume")
        changed = changed_setting(record.config, with_pins(config, record.pins))
        before, after = (
            None if league.sweep is None else league.sweep.model_dump(include=SEARCH_SETTINGS)
            for league in (record.config, config)
        )
        if changed is None and before != after:
            changed = "sweep"
        if changed is not None:
            raise ConfigError(f"{changed} has changed since sweep {newest.parent.name} began: start a new one")
        return cls(newest.parent, record)

    @property
    def size(self) -> int:
        """The number of trials, including those that Optuna has not proposed yet."""
        return size(self.settings, self.record.trials)

    def add(self, settings: Settings, used: Resources, pins: dict[str, str]) -> None:
        """Record the settings of the next trial before it starts. References that are already pinned stay."""
        record = self.record
        changes = {
            "trials": (*record.trials, settings),
            "resources": (*record.resources, used.settings),
            "pins": pins | record.pins,
        }
        self.record = record.model_copy(update=changes)
        write(self.record, self.path / SWEEP_FILE)

    def locked(self) -> AbstractContextManager[None]:
        """Exclude other drivers. Raises AlreadyRunning. The lock ends with the process."""
        return locked(self.path, f"sweep {self.path.name}")

    def league(self, number: int) -> LeagueConfig:
        """Return the league with a trial's settings and resources, and with pinned opponents."""
        league = with_pins(applied(self.record.config, self.record.trials[number]), self.record.pins)
        return league.with_training(**self.record.resources[number]) if self.record.resources else league

    def trial(self, number: int) -> Path:
        """Return the directory of a trial."""
        return self.path / f"trial-{number:03d}"

    def checkpoint(self, number: int) -> Path | None:
        """Return the newest complete checkpoint of a trial."""
        paths = (path for path in (self.trial(number) / CHECKPOINTS).glob("*") if path.name.isdigit())
        return max(paths, key=lambda path: int(path.name), default=None)

    def outcome(self, number: int) -> TrialOutcome | None:
        """Return the result of a trial, if it has ended."""
        file = self.trial(number) / OUTCOME_FILE
        return TrialOutcome.model_validate_json(file.read_text()) if file.exists() else None

    def set_outcome(self, number: int, outcome: TrialOutcome) -> None:
        """Record that a trial has ended."""
        write(outcome, self.trial(number) / OUTCOME_FILE)

    def complete(self) -> None:
        """Record that all trials have ended, and delete their checkpoints."""
        write(self.record.model_copy(update={"complete": True}), self.path / SWEEP_FILE)
        for number in range(len(self.record.trials)):
            shutil.rmtree(self.trial(number) / CHECKPOINTS, ignore_errors=True)


def _sweeps(storage: Storage, league: str) -> Path:
    return storage.home / "sweeps" / league
