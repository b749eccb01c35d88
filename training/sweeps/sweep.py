"""Runs a parameter sweep: Ray Tune trains several trials concurrently, and the best checkpoint becomes a version.

An interrupted sweep can be resumed: finished trials stay, others continue from their newest checkpoint. The sweep keeps
its own files for this (training/sweeps/sweep_directory.py): Tune restores an older snapshot and unpickles the
experiment's driver. After resuming, successive halving compares running trials only with one another, which may let a
weak trial run longer; it never reverts a decision.
"""

import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ray import tune
from ray.tune.schedulers import ASHAScheduler, FIFOScheduler, TrialScheduler
from rich.console import Console

from league.config.league import LeagueConfig
from league.config.sweep import SweepConfig
from league.environments.building import interface as interface_of
from league.errors import ConfigError, LeagueError
from league.interface import Interface
from league.policies.loading import check_contestants, strength_opponents
from league.ray_cluster import UNLIMITED, LocalRay, connected, usable_cpus
from league.registry.registry import Registry
from league.registry.storage.rows import VersionRow
from league.settings import Storage
from training.algorithms import metrics
from training.export.publish import Checkpoint, git_commit, publish
from training.rllib_compat import silence_tune
from training.runs.checkpoint_digests import private_copy
from training.runs.driver_files import DriverMachine, driver_machine
from training.runs.error_messages import training_error
from training.runs.run_directory import CHECKPOINTS, START, pin_opponents
from training.runs.train import check
from training.runs.trial import FROM_SCRATCH, MAX_THREADS, StartState, TrialPlan, read_progress
from training.runs.tune import cpu_share, fit, placement, run_config
from training.sweeps.search_space import Settings, applied, format_settings, plan
from training.sweeps.strength import STRENGTH, StrengthGames, StrengthTest
from training.sweeps.sweep_directory import SweepDirectory, TrialOutcome
from training.sweeps.trial import (
    NUMBER,
    TRIAL,
    StopWhenSaved,
    SweepCallback,
    SweepProgress,
    SweepTrial,
)


@dataclass(frozen=True, slots=True)
class TrialReport:
    """One trial of a sweep. outcome: None if it is not finished. error: why it failed."""

    number: int
    settings: Settings
    outcome: TrialOutcome | None
    error: LeagueError | None

    @property
    def score(self) -> float | None:
        return None if self.outcome is None else self.outcome.score


@dataclass(frozen=True, slots=True)
class SweepReport:
    """best: the trial with the best score among those that spent their budget. version: its published version.
    is_whole: False if the sweep was interrupted.
    """

    path: Path
    trials: list[TrialReport]
    best: TrialReport | None
    version: VersionRow | None
    is_whole: bool


def sweep(
    config: LeagueConfig,
    *,
    registry: Registry,
    resume: bool = False,
    publish_best: bool = True,
    address: str | None = None,
    local: LocalRay = UNLIMITED,
    config_path: Path | None = None,
    console: Console | None = None,
    open_games: Callable[[Storage], StrengthGames] | None = None,
) -> SweepReport:
    """Train the league once per trial of `config.sweep`, and publish the newest checkpoint of the best one.

    Each trial is trained as `train` does, with its own settings; only the best one is published. TensorBoard files are
    in `<home>/sweeps/<league>/<sweep>`.

    The first SIGINT or SIGTERM lets the trials save and ends the sweep without publishing. A second one raises
    KeyboardInterrupt immediately. The sweep can be resumed in both cases.

    Args:
        config: The league, with its `sweep`.
        registry: Where the version is published.
        resume: Continue the league's newest sweep, which was interrupted.
        publish_best: Whether to publish the best trial.
        address, local, config_path, console: See `train`.
        open_games: Opens what plays the games that measure strength, in the process of each trial. Required by the
            metric `strength`.

    Raises:
        LeagueError: `config` has no sweep; an invalid parameter, value or metric, before anything starts; all trials
            failed (the first one's error); what `train` raises.
    """
    if config.sweep is None:
        raise ConfigError(f"{config.league}: sweep is missing: it lists the training settings to try")
    silence_tune()
    interface = interface_of(config)
    trials = plan(config, config.sweep)
    if config.sweep.metric == "auto":
        metric = STRENGTH if len(interface.sides) > 1 else metrics.RETURN
        config = config.model_copy(update={"sweep": config.sweep.model_copy(update={"metric": metric})})
    assert config.sweep is not None
    _check(config, config.sweep, trials, interface, can_play=open_games is not None)
    check_contestants(config, interface, registry)
    registry.leagues.register(config, interface)
    interrupted = SweepDirectory.resume(registry.storage, config, trials) if resume else None
    leagues = [applied(config, settings) for settings in trials]
    pins = {} if interrupted else pin_opponents(config, registry, interface, leagues)
    opponents = strength_opponents(config, registry) if config.sweep.metric == STRENGTH else []
    with connected(address, registry.storage, local) as dashboard:
        directory = interrupted or SweepDirectory.begin(
            registry.storage, config, pins, trials, git_commit(config_path), opponents
        )
        with directory.locked(), SweepProgress(console or Console(), directory, config.sweep.mode) as progress:
            if dashboard:
                progress.say(f"Ray's dashboard: {dashboard}")
            test = None
            if open_games is not None and directory.record.opponents:
                progress.say(f"Strength: mean score against {', '.join(directory.record.opponents)}.")
                test = StrengthTest(directory.record.opponents, open_games)
            errors = _run(directory, interface, registry, progress, test)
        return _conclude(directory, errors, interface, registry, publish_best)


def _conclude(
    sweep: SweepDirectory,
    errors: Mapping[int, LeagueError],
    interface: Interface,
    registry: Registry,
    publish_best: bool,
) -> SweepReport:
    """Find the best trial, publish it, and complete the sweep if all trials have ended."""
    trials = [
        TrialReport(number, settings, sweep.outcome(number), errors.get(number))
        for number, settings in enumerate(sweep.record.trials)
    ]
    sign = 1 if sweep.settings.mode == "max" else -1
    scored = {
        trial.number: sign * trial.score
        for trial in trials
        if trial.outcome is not None and not trial.outcome.ended_early and trial.score is not None
    }
    best, version = trials[max(scored, key=lambda number: scored[number])] if scored else None, None
    is_whole = all(trial.outcome is not None or trial.error is not None for trial in trials)
    if is_whole and best is None and errors:
        raise next(iter(errors.values()))
    if is_whole:
        if best is not None and publish_best:
            version = _publish(sweep, best.number, interface, registry)
        sweep.complete()
    return SweepReport(sweep.path, trials, best, version, is_whole)


def _check(
    config: LeagueConfig, sweep: SweepConfig, trials: list[Settings], interface: Interface, can_play: bool
) -> None:
    names = metrics.metric_names(interface, config.training.algorithm) | {STRENGTH}
    if sweep.metric not in names:
        raise ConfigError(f"sweep.metric: unknown metric {sweep.metric!r}; expected one of {', '.join(sorted(names))}")
    for settings in trials:
        try:
            check(applied(config, settings), interface)
        except ConfigError as error:
            raise ConfigError(f"sweep.parameters: {format_settings(settings)}: {error}") from error
    if sweep.metric == STRENGTH and not can_play:
        raise ConfigError("sweep.metric: strength is measured by games, for which this sweep has no function")
    if sweep.metric == STRENGTH and any(applied(config, settings).training.strength is None for settings in trials):
        raise ConfigError("sweep.metric: strength is measured by the games of training.strength, which is null")
    budget = _max_steps(applied(config, settings) for settings in trials)
    if sweep.asha is not None and sweep.asha.grace_steps > budget:
        raise ConfigError(f"sweep.asha.grace_steps: {sweep.asha.grace_steps} exceeds a trial's steps, {budget}")


def _run(
    sweep: SweepDirectory,
    interface: Interface,
    registry: Registry,
    progress: SweepProgress,
    strength: StrengthTest | None,
) -> dict[int, LeagueError]:
    """Train the unfinished trials; return the errors of those that failed."""
    settings = sweep.settings
    numbers = [number for number in range(len(sweep.record.trials)) if sweep.outcome(number) is None]
    if not numbers:
        return {}
    sweep.stop_file.unlink(missing_ok=True)
    at_once = min(settings.concurrent, len(numbers))
    leagues = {number: sweep.league(number) for number in numbers}
    share = cpu_share(max(league.training.runners for league in leagues.values()), at_once)
    threads = min(MAX_THREADS, max(1, usable_cpus() // at_once))
    driver = driver_machine()
    plans = {
        number: {
            "league": league.model_dump(mode="json", by_alias=True),
            "interface": interface.model_dump(mode="json"),
            "plan": _plan(sweep, number, registry, share, threads, driver),
        }
        for number, league in leagues.items()
    }
    placements = {number: placement(league.training, share) for number, league in leagues.items()}
    watch = SweepCallback(sweep, settings.metric, progress)
    scheduler: TrialScheduler = FIFOScheduler()
    if settings.asha is not None:
        scheduler = ASHAScheduler(
            time_attr="steps",
            metric=settings.metric,
            mode=settings.mode,
            grace_period=settings.asha.grace_steps,
            reduction_factor=settings.asha.reduction_factor,
            # A trial that has spent its budget ends by itself.
            max_t=_max_steps(leagues.values()) + 1,
        )
    tuner = tune.Tuner(
        tune.with_resources(
            tune.with_parameters(SweepTrial, plans=plans, metric=settings.metric, strength=strength),
            lambda config: placements[config[TRIAL][NUMBER]],
        ),
        param_space={TRIAL: tune.grid_search([_shown(sweep, number) for number in numbers])},
        tune_config=tune.TuneConfig(
            scheduler=scheduler,
            max_concurrent_trials=at_once,
            trial_dirname_creator=lambda trial: sweep.trial(trial.config[TRIAL][NUMBER]).name,
        ),
        run_config=run_config(sweep.path, [watch], StopWhenSaved(watch)),
    )
    return {
        (number := result.config[TRIAL][NUMBER]): training_error(
            result.error, sweep.record.config.league, sweep.trial(number) / "error.txt"
        )
        for result in fit(tuner, watch.request_stop)
        if result.error is not None
    }


def _plan(
    sweep: SweepDirectory, number: int, registry: Registry, share: float, threads: int, driver: DriverMachine | None
) -> TrialPlan:
    """Plan a trial from its newest checkpoint."""
    checkpoints = sweep.trial(number) / CHECKPOINTS
    checkpoints.mkdir(parents=True, exist_ok=True)
    start, newest = FROM_SCRATCH, sweep.checkpoint(number)
    if newest is not None:
        state = private_copy(newest, checkpoints / START)
        steps, seconds = read_progress(state)
        start = StartState(state, steps, 0, seconds)
    return TrialPlan(start, checkpoints, sweep.stop_file, registry.storage, cpus=share, threads=threads, driver=driver)


def _max_steps(leagues: Iterable[LeagueConfig]) -> int:
    """Return the largest number of steps of a trial; a trial with a time limit only has no other."""
    return max(league.training.max_steps or sys.maxsize for league in leagues)


def _shown(sweep: SweepDirectory, number: int) -> dict[str, Any]:
    """Return a trial's number and settings for TensorBoard's table of hyperparameters, which accepts no lists."""
    settings = sweep.record.trials[number]
    simple = {name: value if isinstance(value, int | float | str) else str(value) for name, value in settings.items()}
    return {NUMBER: number} | simple


def _publish(sweep: SweepDirectory, number: int, interface: Interface, registry: Registry) -> VersionRow:
    checkpoint = sweep.checkpoint(number)
    assert checkpoint is not None, "a trial that spent its budget has saved"
    copy = private_copy(checkpoint, checkpoint.with_name(f"{checkpoint.name}.copy"))
    return publish(
        Checkpoint(copy, source=f"{sweep.id}/{sweep.trial(number).name}/{checkpoint.name}", steps=int(checkpoint.name)),
        registry=registry,
        config=sweep.league(number),
        interface=interface,
        parent=None,
        git_commit=sweep.record.git_commit,
    )
