"""The directory of a training run: its record, pinned opponents, checkpoints and lock.

<home>/runs/<league>/<run>/
    run.json            the run's configuration; written before training and on completion
    lock                held while a driver works on the run
    attempt-<n>/        Tune's trial and its TensorBoard files; a new attempt at each start
        stop                created to request that the trial saves and ends
        checkpoints/<steps>/    RLlib's state with its digests, until it is published
        checkpoints/start/      a verified copy of the version that the attempt started from
"""

import json
import logging
import math
import re
import secrets
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from filelock import FileLock, Timeout
from pydantic import BaseModel, Field, ValidationError

from league.config.base import JSON, Part
from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.config.validation_errors import describe_validation_error
from league.errors import AlreadyRunning, ConfigError, NotFound, RunCorrupt
from league.files import disk_errors, replacing
from league.frozen import FrozenModel
from league.interface import Interface
from league.policies.loading import contestant, players
from league.policies.open_inference import fixed_version
from league.refs import CheckpointRef, RemoteRef, of_league, parse_ref
from league.registry.processes import host_name, is_local
from league.registry.registry import Registry
from league.registry.storage.manifest import MAIN, Role, trained_role
from league.registry.storage.rows import HEARTBEAT_TIMEOUT, RunRow
from league.registry.training.runs import RUNNING
from league.settings import Storage
from training.algorithms.resources import AUTO, Resources


def write(record: BaseModel, path: Path) -> None:
    """Replace the record at `path` atomically."""
    with replacing(path) as draft:
        draft.write_text(record.model_dump_json(indent=2, by_alias=True))


@contextmanager
def locked(directory: Path, what: str) -> Iterator[None]:
    """Exclude other processes from `directory`. Raises AlreadyRunning. The lock ends with the process."""
    lock = FileLock(directory / "lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise AlreadyRunning(f"{what} is running in another process") from error
    try:
        yield
    finally:
        lock.release()


def pin_opponents(
    config: LeagueConfig, registry: Registry, interface: Interface, trials: Iterable[LeagueConfig] = ()
) -> dict[str, str]:
    """Resolve each opponent of `training.opponents`, the version of the magnet and the teacher: reference as written
    → `script:name`, `league@number`, or the URL of a version of a remote model.

    trials: the league with the settings of a sweep's trials, whose references are resolved, too. In training, a search
    version plays without its search.

    Raises what loading a contestant raises: it does not exist, or does not fit the league.
    """
    pins = {}
    references: list[tuple[str | None, bool]] = []  # with whether it is an opponent
    for settings in (variant.training for variant in (config, *trials)):
        references += [(opponent.ref, True) for opponent in settings.opponents.fixed]
        if isinstance(settings, PPOConfig):
            references.append((settings.magnet.version if settings.magnet else None, False))
            references.append((settings.teacher.ref if settings.teacher else None, False))
    for written, is_opponent in dict.fromkeys(references):
        if written is None:
            continue
        ref = parse_ref(of_league(written, config.league))
        if isinstance(ref, RemoteRef):
            ref = fixed_version(ref, interface)
        pinned = str(ref)
        if isinstance(ref, CheckpointRef):
            version = registry.versions.resolve(ref)
            pinned = version.ref if version.search is None else f"{version.league}@{version.search.version}"
        for player in players(pinned, registry) if is_opponent else [pinned]:
            contestant(player, registry, interface)
        pins[written] = pinned
    return pins


def with_pins(config: LeagueConfig, pins: dict[str, str]) -> LeagueConfig:
    """Return the league with its references replaced by what they are pinned to; others are unchanged."""

    def pinned(part: Part) -> JSON:
        document = part.model_dump()
        return document | {"ref": pins.get(document["ref"], document["ref"])}

    settings = config.training
    changes: JSON = {
        "opponents": settings.opponents.model_dump()
        | {"fixed": [pinned(opponent) for opponent in settings.opponents.fixed]}
    }
    if isinstance(settings, PPOConfig):
        parts = {"magnet": settings.magnet, "teacher": settings.teacher}
        changes |= {name: pinned(part) for name, part in parts.items() if part is not None}
    return config.with_training(**changes)


logger = logging.getLogger("policy_league")
POLL = 1.0
"""Polling interval in seconds for a heartbeat."""
RUN_FILE = "run.json"
ATTEMPT = "attempt-"
CHECKPOINTS = "checkpoints"
START = "start"
"""In the directory of checkpoints: a private, verified copy of the state that training starts from."""
STOP_FILE = "stop"
OWN_ID = re.compile(r"\d{8}-\d{6}-[0-9a-f]{6}")
"""The id of a run that was started without a name: its start time and a random part."""
RESOURCES = {"runners", "learners", "threads", "gpus", "runner_gpus", "crashes", "strength"}
"""Training settings that depend on the machine."""
RESUMABLE_SETTINGS = {
    *("steps", "minutes", "checkpoint_every", "checkpoint_minutes", "exploiter", "callbacks", "trackers"),
    *RESOURCES,
}
"""Training settings that may change when a run is resumed: duration and resources, not what is learned. The settings of
`exploiter` are those of other runs; in an exploiter's own run they have replaced those of the league."""


class RunRecord(FrozenModel):
    """The content of run.json."""

    config: LeagueConfig
    """The league, with pinned opponents."""
    pins: dict[str, str] = Field(default={})
    """Opponents as the user wrote them → what they resolved to when the run began."""
    parent: int | None
    parent_steps: int = 0
    """Steps of the parent when the run began; 0 without one."""
    exploits: str | None = None
    """The version that an exploiter is trained against."""
    git_commit: str | None
    code: dict[str, str] = Field(default={})
    """Entry point → SHA-256 of its source files when the run began, of the user's code in `training`."""
    started_at: datetime
    complete: bool = False

    @property
    def role(self) -> Role:
        """The role of its versions."""
        return trained_role(self.exploits)


class RunDirectory:
    """One training run of a league."""

    def __init__(self, path: Path, record: RunRecord) -> None:
        self.path = path
        self.record = record

    @property
    def id(self) -> str:
        """Unique among all runs: its start time and a random part."""
        return self.path.name

    @classmethod
    def begin(
        cls,
        storage: Storage,
        config: LeagueConfig,
        parent: int | None,
        git_commit: str | None,
        pins: dict[str, str] | None = None,
        exploits: str | None = None,
        name: str | None = None,
        parent_steps: int = 0,
    ) -> Self:
        """Create the directory of a new run.

        pins: what the opponents' references resolve to. exploits: the version that an exploiter is trained against.
        name: the id of the run, by default its start time and a random part. parent_steps: those of the parent.
        """
        pins = pins or {}
        config = with_pins(config, pins)
        started_at = datetime.now(UTC)
        path = _runs(storage, config.league) / (name or f"{started_at:%Y%m%d-%H%M%S}-{secrets.token_hex(3)}")  # OWN_ID
        record = RunRecord(
            config=config,
            pins=pins,
            parent=parent,
            parent_steps=parent_steps,
            exploits=exploits,
            git_commit=git_commit,
            code=config.training_code(),
            started_at=started_at,
        )
        return cls._at(path, record, may_exist=name is not None)

    @classmethod
    def find(cls, registry: Registry, config: LeagueConfig, name: str) -> Self | None:
        """Return the run with this id, if it has begun, on this machine or another one.

        It keeps its settings, except that an incomplete one has the resources of `config`, chosen anew where they are
        `auto`: the machine may be a smaller one.

        Raises AlreadyRunning if it is trained on another machine.
        """
        _wait_for_other_machine(registry, config.league, name)
        path = _runs(registry.storage, config.league) / name
        record = _records(registry, config.league, name).get(path)
        if record is None:
            return None
        if not record.complete:
            resources = config.training.model_dump(include=RESOURCES, by_alias=True)
            record = record.model_copy(update={"config": record.config.with_training(**resources)})
        return cls._at(path, record)

    @classmethod
    def resume(cls, registry: Registry, config: LeagueConfig, role: Role = MAIN) -> Self:
        """Open the league's newest run of a role if it is incomplete: it was interrupted, or its budget is larger now.

        It may have begun on another machine, with the same registry. Runs of training nights and of the gate are
        excluded; `league nightly` resumes those.

        Raises NotFound; ConfigError if `config` differs; AlreadyRunning if it is trained on another machine.
        """
        records = _records(registry, config.league)
        paths = (path for path, record in records.items() if record.role == role and OWN_ID.fullmatch(path.name))
        newest = max(paths, default=None)
        if newest is None:
            raise NotFound(
                f"league {config.league} has no training run with the role {role}, neither in"
                f" {_runs(registry.storage, config.league)} nor in the registry: there is nothing to resume"
            )
        _wait_for_other_machine(registry, config.league, newest.name)
        record = _records(registry, config.league)[newest]
        if record.exploits is not None:
            config = config.against(record.exploits)
        # Where the file says auto, the run keeps what it has used so far.
        written, used = config.training.model_dump(), record.config.training.model_dump()
        automatic = [field.name for field in fields(Resources) if written[field.name] == AUTO]
        config = with_pins(config, record.pins).with_training(**{name: used[name] for name in automatic})
        if (changed := changed_setting(record.config, config)) is not None:
            raise ConfigError(
                f"{changed} has changed since training run {newest.name} began, so it cannot be resumed: "
                f"set it back, or start a new run without --resume (with --from to continue from a version)"
            )
        # One larger limit is enough; the trial checks the other one.
        (old_steps, old_minutes), (steps, minutes) = (
            (settings.max_steps or math.inf, settings.minutes or math.inf)
            for settings in (record.config.training, config.training)
        )
        if record.complete and steps <= old_steps and minutes <= old_minutes:
            raise NotFound(
                f"training run {newest.name} is complete: there is nothing to resume, unless --steps or"
                " --minutes is larger"
            )
        return cls._at(newest, record.model_copy(update={"config": config, "complete": False}))

    @classmethod
    def _at(cls, path: Path, record: RunRecord, *, may_exist: bool = True) -> Self:
        """Write the record of a run, which may exist, here or on another machine."""
        run = cls(path, record)
        with disk_errors(path):
            path.mkdir(parents=True, exist_ok=may_exist)
            run._write()
        return run

    def locked(self) -> AbstractContextManager[None]:
        """Exclude other drivers. Raises AlreadyRunning. The lock ends with the process."""
        return locked(self.path, f"training run {self.id}")

    def attempts(self) -> list[Path]:
        """Return the directories of the run's starts, oldest first."""
        return sorted(self.path.glob(f"{ATTEMPT}*"), key=lambda attempt: int(attempt.name.removeprefix(ATTEMPT)))

    def next_attempt(self) -> Path:
        """Return the directory of the next start."""
        last = max((int(attempt.name.removeprefix(ATTEMPT)) for attempt in self.attempts()), default=0)
        return self.path / f"{ATTEMPT}{last + 1}"

    def checkpoints(self) -> list[Path]:
        """Return complete, unpublished checkpoints by their steps."""
        paths = self.path.glob(f"{ATTEMPT}*/{CHECKPOINTS}/*")
        return sorted((path for path in paths if path.name.isdigit()), key=lambda path: int(path.name))

    def remove_checkpoints(self) -> None:
        """Delete the checkpoints of earlier attempts, complete or not, after all complete ones are published."""
        for attempt in self.attempts():
            shutil.rmtree(attempt / CHECKPOINTS, ignore_errors=True)

    def use(self, used: Resources) -> None:
        """Record what the run uses in place of `auto`."""
        config = self.record.config.with_training(**used.settings)
        self.record = self.record.model_copy(update={"config": config})
        self._write()

    def complete(self) -> None:
        """Record that the budget is spent and everything is published."""
        self.record = self.record.model_copy(update={"complete": True})
        self._write()

    def _write(self) -> None:
        write(self.record, self.path / RUN_FILE)


def _runs(storage: Storage, league: str) -> Path:
    return storage.home / "runs" / league


def _records(registry: Registry, league: str, run: str | None = None) -> dict[Path, RunRecord]:
    """Return directory → record of the runs of this machine, and of the newest, or one, in the registry.

    The registry has the newer record of a run that another machine trained last.
    """
    runs = _runs(registry.storage, league)
    records = {file.parent: _record(file.read_text(), str(file)) for file in runs.glob(f"*/{RUN_FILE}")}
    for stored in registry.runs.stored(league, run):
        if runs / stored.id not in records or not is_local(stored.driver):
            record = (stored.record or {}) | {"complete": stored.state == "ended"}
            records[runs / stored.id] = _record(record, f"run {stored.id} in the registry")
    return records


def _record(found: str | dict[str, Any], source: str) -> RunRecord:
    """Parse a run's record, JSON or its object. Raises RunCorrupt, which names `source` and the keys."""
    try:
        return RunRecord.model_validate_json(found) if isinstance(found, str) else RunRecord.model_validate(found)
    except ValidationError as error:
        raise RunCorrupt(f"{source}: {describe_validation_error(error, found)}") from error


def _wait_for_other_machine(registry: Registry, league: str, run: str) -> None:
    """Wait until the process on another machine that trained a run is silent, if there is one. The lock excludes those
    on this machine.

    Raises AlreadyRunning if it sends another heartbeat.
    """
    previous_run: RunRow | None = None
    while stored := registry.runs.stored(league, run):
        (current_run,) = stored
        if current_run.state != RUNNING or is_local(current_run.driver):
            return
        if previous_run is None:
            logger.warning(
                "training run %s was running on %s; waiting for up to %.0f s to see whether it is still",
                *(run, host_name(current_run.driver), HEARTBEAT_TIMEOUT.total_seconds()),
            )
        elif current_run.heartbeat_at != previous_run.heartbeat_at:
            raise AlreadyRunning(f"training run {run} is running on {host_name(current_run.driver)}")
        previous_run = current_run
        time.sleep(POLL)


def changed_setting(old: LeagueConfig, new: LeagueConfig) -> str | None:
    """Return the first setting that differs and affects what is learned."""
    if old.environment.model_dump() != new.environment.model_dump():  # the folder of its code may be another one
        return "environment"
    if old.policies != new.policies:
        return "policies"
    before, after = (json.loads(config.training.model_dump_json(by_alias=True)) for config in (old, new))
    for key in before.keys() | after.keys():
        if key not in RESUMABLE_SETTINGS and before.get(key) != after.get(key):
            return f"training.{key}"
    return None
