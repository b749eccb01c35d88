"""A night of training: train, gate, train an exploiter of the champion, measure its exploitability.

The result of each step is recorded in the registry before the next step begins. The next process repeats a step that
was interrupted: its training run and its schedules have fixed names, so that it continues and nothing is done twice.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from evaluation.gating.criteria.exploitability import exploitability
from evaluation.gating.nightly import NightlyListener, NightlyReport, nightly
from evaluation.gating.trained_exploiters import Trainer, check_exploiters, trainable_version, trained_exploiters
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import AlreadyRunning, LeagueError, StorageError, UnknownRun, one_line
from league.policies.loading import check_contestants
from league.random.seeds import derive
from league.refs import CHAMPION, CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.rows import TrainingNightRow

WAIT = 10.0
"""Seconds between attempts to begin the gate while another nightly run of the league is active."""


@dataclass
class _Night:
    config: LeagueConfig
    registry: Registry
    row: TrainingNightRow
    train: Trainer
    workers: int | None
    listener: NightlyListener | None
    announce: Callable[[str], None]
    gate_report: NightlyReport | None = field(default=None)

    def versions(self, run: str) -> list[str]:
        """References of the versions that a training run has published."""
        rows = self.registry.versions.all(self.config.league)
        return [row.ref for row in rows if row.run == run]

    def earlier_exploiters(self, target: str) -> dict[str, Any] | None:
        """The newest result of an earlier night that trained exploiters of the same champion in the same environment.

        Failed results and results with removed versions do not count.
        """
        league = self.registry.leagues.get(self.config.league)
        usable = {
            row.ref
            for row in self.registry.versions.all(league.slug)
            if row.manifest.environment_digest == league.environment_digest
        }
        nights = self.registry.training_nights.all(league.slug)
        for result in (night.steps.get("exploiter", {}) for night in reversed(nights) if night.id < self.row.id):
            versions = result.get("versions")
            if result.get("target") == target and "error" not in result and versions and usable.issuperset(versions):
                return result
        return None


def training_night(
    config: LeagueConfig,
    *,
    registry: Registry,
    train: Trainer,
    workers: int | None = 0,
    listener: NightlyListener | None = None,
    announce: Callable[[str], None] = lambda _: None,
) -> tuple[TrainingNightRow, NightlyReport | None]:
    """Begin a league's night of training, or continue the one that was interrupted.

    A failed training run or measurement does not stop the night: its step records the error.

    Args:
        config: Configuration of the league.
        registry: Registry of the league.
        train: Trains a run.
        workers: Parallel Ray tasks, as in `play_schedule`.
        listener: Receives progress and verdicts.
        announce: Receives a sentence at the beginning of each step.

    Returns:
        The night with the results of its steps, and the report of the gate if this process ran it.

    Raises:
        AlreadyRunning: Another process works on a night of this league, or on one of its training runs.
        LeagueError: The errors of `nightly`.
    """
    with registry.exclusive_lock(f"training-night-{config.league}"):
        league_interface = interface(config)
        check_contestants(config, league_interface, registry)
        check_exploiters(config, league_interface)
        registry.leagues.register(config, league_interface)
        row = registry.training_nights.open(config.league)
        night = _Night(config, registry, row, train, workers, listener, announce)
        for number, (name, step) in enumerate(STEPS.items(), 1):
            if name not in night.row.steps:
                announce(f"{config.league}: night {row.number}, step {number} of {len(STEPS)}: {name}")
                night.row = registry.training_nights.record(row.id, name, step(night))
        return registry.training_nights.close(row.id), night.gate_report


def _train(night: _Night) -> dict[str, Any]:
    seed = _seed(night)
    parent = night.row.parent
    if parent is not None:
        parent = trainable_version(night.registry, night.config.league, parent)
    run = night.row.run
    error = _attempt(night, night.config.of_night(seed), run, parent, None)
    return {"run": run, "versions": night.versions(run)} | _start(night, run) | error


def _start(night: _Night, run: str) -> dict[str, int | None]:
    """The version that a run started from, which `train` decides; nothing if it never began."""
    try:
        return {"start": night.registry.runs.get(night.config.league, run).parent}
    except UnknownRun:
        return {}


def _seed(night: _Night, *path: str) -> int:
    """Seed of a training run. NumPy's legacy generator, which RLlib seeds, takes 32 bits."""
    return derive(night.config.training.seed, "night", night.row.id, *path) % 2**31


def _attempt(night: _Night, config: LeagueConfig, run: str, parent: int | None, target: str | None) -> dict[str, str]:
    """Train. Returns the error, if any."""
    try:
        night.train(config, name=run, parent=parent, target=target)
    except (AlreadyRunning, StorageError):
        raise
    except LeagueError as error:
        return {"error": one_line(error)}
    return {}


def _gate(night: _Night) -> dict[str, Any]:
    registry, league = night.registry, night.config.league
    night.gate_report = _nightly_run(night)
    began = night.row.began_at
    verdicts = [
        {"candidate": f"{league}@{row.candidate}", "opponent": row.champion, "outcome": row.outcome}
        for row in registry.verdicts.all(league)
        if row.closed_at is not None and row.closed_at >= began
    ]
    champion = registry.aliases.current(league).get(CHAMPION)
    before = registry.aliases.history(league, at=began)
    return {
        "champion_before": f"{league}@{before[0].version}" if before else None,
        "champion": None if champion is None else f"{league}@{champion}",
        "verdicts": verdicts,
    }


def _nightly_run(night: _Night) -> NightlyReport:
    """Run the gate, once no other nightly run of the league is active.

    The configuration is the one that is registered now: a person may have changed it while the night trained.
    """
    waits = False
    while True:
        config = night.registry.leagues.get(night.config.league).config
        try:
            return nightly(
                config, registry=night.registry, train=night.train, workers=night.workers, listener=night.listener
            )
        except AlreadyRunning as error:
            if not waits:
                night.announce(f"{night.config.league}: {error}; waiting until it ends")
            waits = True
            time.sleep(WAIT)


def _exploiter(night: _Night) -> dict[str, Any]:
    """Train an exploiter of the champion, unless there is one from an earlier night or from the gate."""
    target, share = night.row.steps["gate"]["champion"], night.config.nightly.exploiter
    league = night.registry.leagues.get(night.config.league)
    if target is None or share == 0 or len(league.interface.sides) < 2:
        return {"target": target, "versions": []}
    if not (training := night.config.training).supports_opponents:
        night.announce(f"{league.slug}: {training.algorithm} does not support opponents, so {target} gets no exploiter")
        return {"target": target, "versions": []}
    if (earlier := night.earlier_exploiters(target)) is not None:
        return earlier
    run, config = night.row.exploiter_run, night.config.of_night(_seed(night, "exploiter"), share)
    if not night.versions(run) and (exploiters := trained_exploiters(night.registry, league, target, config)):
        return {"target": target, "versions": exploiters}
    parent = CheckpointRef.parse(target).version
    assert isinstance(parent, int)
    error = _attempt(night, config, run, trainable_version(night.registry, league.slug, parent), target)
    return {"target": target, "run": run, "versions": night.versions(run)} | error


def _measure(night: _Night) -> dict[str, Any]:
    """Play the champion against its exploiters: the last version of each run.

    Matches under the same conditions are in the ledger and not played again.
    """
    exploiter = night.row.steps["exploiter"]
    target, versions = exploiter["target"], exploiter["versions"]
    if not versions:
        return {"target": target, "exploitability": None}
    last = {row.run: row.ref for row in night.registry.versions.all(night.config.league) if row.ref in versions}
    try:
        estimate = exploitability(
            CheckpointRef.parse(target),
            list(last.values()),
            registry=night.registry,
            workers=night.workers,
            listener=night.listener,
        )
    except (AlreadyRunning, StorageError):
        raise
    except LeagueError as error:
        return {"target": target, "exploitability": None, "error": one_line(error)}
    return {"target": target, "exploitability": estimate.to_json()}


STEPS: dict[str, Callable[[_Night], dict[str, Any]]] = {
    "train": _train,
    "gate": _gate,
    "exploiter": _exploiter,
    "measure": _measure,
}
"""The steps of a night, in order."""
