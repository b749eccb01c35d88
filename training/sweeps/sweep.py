"""Runs a parameter sweep: Ray Tune trains several trials concurrently, and the best checkpoint becomes a version.

An interrupted sweep can be resumed: finished trials stay, others continue from their newest checkpoint. The sweep keeps
its own files for this (training/sweeps/sweep_directory.py): Tune restores an older snapshot and unpickles the
experiment's driver. After resuming, successive halving compares running trials only with one another, which may let a
weak trial run longer; it never reverts a decision.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from ray import tune
from ray.tune.schedulers import ASHAScheduler, FIFOScheduler, TrialScheduler
from rich.console import Console

from league.config.league import LeagueConfig
from league.config.marwil import MARWILConfig
from league.config.sweep import SweepConfig
from league.environments.building import interface as interface_of
from league.errors import ConfigError, LeagueError
from league.interface import Interface
from league.local_ray.loopback_node import is_own
from league.policies.loading import check_contestants, strength_opponents
from league.ray_cluster import UNLIMITED, LocalRay, connected, node_resources
from league.registry.registry import Registry
from league.registry.storage.rows import VersionRow
from league.settings import Storage
from training.algorithms import metrics
from training.algorithms.resources import Nodes, Resources, resources
from training.algorithms.rllib_config import algorithm_class, with_algorithm
from training.export.publish import Checkpoint, git_commit, publish
from training.rllib_compat import silence_tune, use_waiting_workers
from training.runs.checkpoint_digests import private_copy
from training.runs.driver_files import DriverMachine, driver_machine
from training.runs.error_messages import training_error
from training.runs.run_directory import CHECKPOINTS, START, pin_opponents
from training.runs.train import check
from training.runs.trial import FROM_SCRATCH, StartState, TrialPlan, read_progress
from training.runs.tune import cpu_share, fit, placement, run_config
from training.sweeps.search_space import Settings, TrialOutcome, applied, format_settings, plan, propose, size
from training.sweeps.strength import STRENGTH, StrengthGames, StrengthTest
from training.sweeps.sweep_directory import SweepDirectory
from training.sweeps.trial import (
    ARGUMENTS,
    NUMBER,
    TRIAL,
    PlannedTrials,
    StopWhenSaved,
    SweepCallback,
    SweepProgress,
    SweepTrial,
    TrialArguments,
)

PROPOSALS = 100
"""How often Optuna proposes settings for a trial, until they are valid together."""
T = TypeVar("T")


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

    The first SIGINT, SIGTERM or SIGHUP lets the trials save and ends the sweep without publishing. A second one raises
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
    config = with_algorithm(config)
    if config.sweep is None:
        raise ConfigError(f"{config.league}: sweep is missing: it lists the training settings to try")
    silence_tune()
    interface = interface_of(config)
    if config.sweep.metric == "auto":
        metric = STRENGTH if len(interface.sides) > 1 else metrics.RETURN
        config = config.model_copy(update={"sweep": config.sweep.model_copy(update={"metric": metric})})
    assert config.sweep is not None
    console = console or Console()
    if config.sweep.search == "random":
        trials = plan(config, config.sweep)
        leagues = [_checked(config, interface, settings) for settings in trials]
    else:
        first, league = _proposed(config, (), partial(_checked, config, interface), console.print)
        trials, leagues = [first], [league]
    _check(config, config.sweep, leagues, interface, can_play=open_games is not None)
    check_contestants(config, interface, registry)
    registry.leagues.register(config, interface)
    interrupted = SweepDirectory.resume(registry.storage, config) if resume else None
    pins = {} if interrupted else pin_opponents(config, registry, interface, leagues)
    opponents = strength_opponents(config, registry) if config.sweep.metric == STRENGTH else []
    with connected(address, registry.storage, local) as dashboard:
        if is_own():
            use_waiting_workers()
        nodes = _part(config.sweep, size(config.sweep, trials))
        used = [resources(league, len(interface.agents), nodes) for league in leagues]
        directory = interrupted or SweepDirectory.begin(
            registry.storage, config, pins, trials, git_commit(config_path), opponents, used
        )
        with directory.locked(), SweepProgress(console, directory, config.sweep.mode) as progress:
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
    ended = [trial for trial in trials if trial.outcome is not None or trial.error is not None]
    is_whole = len(ended) == sweep.size
    if is_whole and best is None and errors:
        raise next(iter(errors.values()))
    if is_whole:
        if best is not None and publish_best:
            version = _publish(sweep, best.number, interface, registry)
        sweep.complete()
    return SweepReport(sweep.path, trials, best, version, is_whole)


def _checked(config: LeagueConfig, interface: Interface, settings: Settings) -> LeagueConfig:
    """Return the league with the settings of a trial. Raises ConfigError if it cannot be trained."""
    try:
        league = applied(config, settings)
        check(league, interface)
    except ConfigError as error:
        raise ConfigError(f"sweep.parameters: {format_settings(settings)}: {error}") from error
    if config.sweep is not None and config.sweep.metric == STRENGTH and league.training.strength is None:
        raise ConfigError("sweep.metric: strength is measured by the games of training.strength, which is null")
    return league


def _proposed(
    config: LeagueConfig,
    trials: Sequence[tuple[Settings, TrialOutcome | None]],
    use: Callable[[Settings], T],
    say: Callable[[str], None],
) -> tuple[Settings, T]:
    """Return the settings that Optuna proposes after `trials`, and what `use` makes of them.

    Settings may exclude each other. If `use` raises a LeagueError, Optuna proposes again.
    """
    assert config.sweep is not None
    for attempt in range(PROPOSALS):
        settings = propose(config, config.sweep, trials, attempt)
        try:
            return settings, use(settings)
        except LeagueError as error:
            latest = error
            say(f"Not tried: {error}")
    raise ConfigError(f"{PROPOSALS} proposals of Optuna are invalid, such as {latest}")


def _check(
    config: LeagueConfig, sweep: SweepConfig, leagues: Sequence[LeagueConfig], interface: Interface, can_play: bool
) -> None:
    names = metrics.metric_names(interface, algorithm_class(config.training.algorithm).curves) | {STRENGTH}
    if isinstance(config.training, MARWILConfig):  # it plays no episodes
        names -= metrics.metric_names(interface, ())
    if sweep.metric not in names:
        raise ConfigError(f"sweep.metric: unknown metric {sweep.metric!r}; expected one of {', '.join(sorted(names))}")
    if sweep.metric == STRENGTH and not can_play:
        raise ConfigError("sweep.metric: strength is measured by games, for which this sweep has no function")
    budget = max(league.training.max_steps or sys.maxsize for league in leagues)
    if sweep.asha is not None and sweep.asha.grace_steps > budget:
        raise ConfigError(f"sweep.asha.grace_steps: {sweep.asha.grace_steps} exceeds a trial's steps, {budget}")


def _part(sweep: SweepConfig, trials: int) -> Nodes:
    """Return the part of each node that one of `trials` trials gets."""
    at_once = min(sweep.concurrent, trials)
    return [{name: amount / at_once for name, amount in node.items()} for node in node_resources()]


def _run(
    sweep: SweepDirectory,
    interface: Interface,
    registry: Registry,
    progress: SweepProgress,
    strength: StrengthTest | None,
) -> dict[int, LeagueError]:
    """Train the unfinished trials; return the errors of those that failed."""
    settings = sweep.settings
    unfinished = sum(sweep.outcome(number) is None for number in range(sweep.size))
    if not unfinished:
        return {}
    sweep.stop_file.unlink(missing_ok=True)
    at_once = min(settings.concurrent, unfinished)
    agents, driver = len(interface.agents), driver_machine()
    planned = [resources(sweep.league(number), agents) for number in range(len(sweep.record.trials))]
    share = cpu_share(max(used.processes for used in planned), at_once)
    for used in planned:
        placement(used, share)  # raises before the first trial starts

    def place(proposal: Settings) -> tuple[Resources, dict[str, str]]:
        league = _checked(sweep.record.config, interface, proposal)
        used = resources(league, agents, _part(settings, sweep.size))
        placement(used, share)
        return used, pin_opponents(sweep.record.config, registry, interface, [league])

    def trials() -> Iterator[dict[str, Any]]:
        for number in range(sweep.size):
            if sweep.stop_file.exists():
                return
            if number == len(sweep.record.trials):
                past = [(trial, sweep.outcome(before)) for before, trial in enumerate(sweep.record.trials)]
                proposal, (used, pins) = _proposed(sweep.record.config, past, place, progress.say)
                sweep.add(proposal, used, pins)
            if sweep.outcome(number) is None:
                league, plan = sweep.league(number), _plan(sweep, number, registry, share, driver)
                yield {
                    TRIAL: _shown(sweep, number),
                    ARGUMENTS: TrialArguments(league.model_dump(by_alias=True), interface, plan),
                }

    watch = SweepCallback(sweep, settings.metric, progress)
    scheduler: TrialScheduler = FIFOScheduler()
    if settings.asha is not None:
        scheduler = ASHAScheduler(
            time_attr="steps",
            metric=settings.metric,
            mode=settings.mode,
            grace_period=settings.asha.grace_steps,
            reduction_factor=settings.asha.reduction_factor,
            max_t=sys.maxsize,  # a trial that has spent its budget ends by itself
        )
    tuner = tune.Tuner(
        tune.with_resources(
            tune.with_parameters(SweepTrial, metric=settings.metric, strength=strength),
            lambda config: placement(resources(LeagueConfig.model_validate(config[ARGUMENTS].league), agents), share),
        ),
        tune_config=tune.TuneConfig(
            scheduler=scheduler,
            search_alg=PlannedTrials(trials()),
            num_samples=unfinished,
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
    sweep: SweepDirectory, number: int, registry: Registry, share: float, driver: DriverMachine | None
) -> TrialPlan:
    """Plan a trial from its newest checkpoint."""
    checkpoints = sweep.trial(number) / CHECKPOINTS
    checkpoints.mkdir(parents=True, exist_ok=True)
    start, newest = FROM_SCRATCH, sweep.checkpoint(number)
    if newest is not None:
        state = private_copy(newest, checkpoints / START)
        steps, seconds = read_progress(state)
        start = StartState(state, steps, 0, seconds)
    return TrialPlan(start, checkpoints, sweep.stop_file, registry.storage, cpus=share, driver=driver)


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
