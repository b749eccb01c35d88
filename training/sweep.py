"""A parameter sweep: Ray Tune runs its trials, a few at a time, and the best one's checkpoint becomes a version.

An interrupted sweep goes on: trials that are over stay as they are, those under way go on from their newest checkpoint.
That is kept by files of our own (training/sweeps.py): Tune's restoring goes back to a snapshot that lags behind, and
unpickles what drove the experiment. Successive halving then compares the trials that still run with one another alone,
which may let a weak one run longer, and never takes back a decision.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ray import tune
from ray.tune.schedulers import ASHAScheduler, FIFOScheduler, TrialScheduler
from rich.console import Console

from league.config import LeagueConfig, SweepConfig
from league.environments.building import interface as interface_of
from league.errors import ConfigError, LeagueError
from league.interface import Interface
from league.registry.registry import Registry
from league.registry.rows import VersionRow
from training import curves
from training.cluster import UNLIMITED, LocalRay, connected
from training.faults import told
from training.pinning import pin
from training.publish import Checkpoint, git_commit, publish
from training.resources import cpu_share, placement
from training.run import check
from training.runs import CHECKPOINTS
from training.search import Settings, applied, plan
from training.sweep_progress import SweepProgress, described
from training.sweep_trial import NUMBER, TRIAL, StopAtRest, SweepTrial, Watch
from training.sweeps import Outcome, Sweep
from training.trial import AFRESH, MAX_THREADS, Plan, Start, read_progress
from training.tuning import fit, quiet, run_config


@dataclass(frozen=True, slots=True)
class TrialReport:
    """One trial of a sweep. outcome: None where it is not over. error: why it broke off."""

    number: int
    settings: Settings
    outcome: Outcome | None
    error: LeagueError | None

    @property
    def score(self) -> float | None:
        return None if self.outcome is None else self.outcome.score


@dataclass(frozen=True, slots=True)
class SweepReport:
    """best: the trial with the best score, of those that have used their whole budget. version: what it was published
    as. is_whole: False where the sweep was asked to end."""

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
) -> SweepReport:
    """Train the league once for each trial of `config.sweep`, and publish the newest checkpoint of the best.

    Each trial is trained as `train` would train it, with settings of its own; the league's are those of the others.
    Nothing but the best one is published. TensorBoard files of all are below `<home>/sweeps/<league>/<sweep>`.

    resume: go on with the newest sweep of the league, which was interrupted. The others are those of `train`.

    A first SIGINT or SIGTERM lets the trials save and ends the sweep, nothing is published; a second one raises
    KeyboardInterrupt at once. In both cases it can be resumed.

    Raises LeagueError: no sweep in `config`; a parameter, value or metric that there is not, before anything starts;
    no trial that came to an end without an error, which is then the first one's; what `train` raises.
    """
    if config.sweep is None:
        raise ConfigError(f"{config.league}: sweep is missing: it says which training settings to try")
    quiet()
    interface = interface_of(config)
    trials = plan(config, config.sweep)
    _check(config, config.sweep, trials, interface)
    registry.register(config, interface)
    interrupted = Sweep.resume(registry.storage, config, trials) if resume else None
    pins = {} if interrupted else pin(config, registry, interface)
    with connected(address, registry.storage, local) as dashboard:
        this = interrupted or Sweep.begin(registry.storage, config, pins, trials, git_commit(config_path))
        with this.locked(), SweepProgress(console or Console(), this, config.sweep.mode) as progress:
            if dashboard:
                progress.say(f"Ray's dashboard: {dashboard}")
            errors = _run(this, interface, registry, progress)
        return _conclude(this, errors, interface, registry, publish_best)


def _conclude(
    sweep: Sweep, errors: Mapping[int, LeagueError], interface: Interface, registry: Registry, publish_best: bool
) -> SweepReport:
    """Find the best, publish it, and complete the sweep if it has come to its end."""
    trials = [
        TrialReport(number, settings, sweep.outcome(number), errors.get(number))
        for number, settings in enumerate(sweep.record.trials)
    ]
    best, version = _best(trials, _settings(sweep)), None
    is_whole = all(trial.outcome is not None or trial.error is not None for trial in trials)
    if is_whole and best is None and errors:
        raise next(iter(errors.values()))
    if is_whole:
        if best is not None and publish_best:
            version = _publish(sweep, best.number, interface, registry)
        sweep.complete()
    return SweepReport(sweep.path, trials, best, version, is_whole)


def _check(config: LeagueConfig, sweep: SweepConfig, trials: list[Settings], interface: Interface) -> None:
    if sweep.metric not in (known := curves.names(interface, config.training.algorithm)):
        raise ConfigError(f"sweep.metric: no curve {sweep.metric!r}; expected one of {', '.join(sorted(known))}")
    for settings in trials:
        try:
            check(applied(config, settings), interface)
        except ConfigError as error:
            raise ConfigError(f"sweep.parameters: {described(settings)}: {error}") from error
    budget = max(applied(config, settings).training.steps for settings in trials)
    if sweep.asha is not None and sweep.asha.grace_steps > budget:
        raise ConfigError(f"sweep.asha.grace_steps: {sweep.asha.grace_steps} are more than a trial's steps, {budget}")


def _run(sweep: Sweep, interface: Interface, registry: Registry, progress: SweepProgress) -> dict[int, LeagueError]:
    """Train the trials that are not over, and tell which of them broke off."""
    settings = _settings(sweep)
    numbers = [number for number in range(len(sweep.record.trials)) if sweep.outcome(number) is None]
    if not numbers:
        return {}
    sweep.end.unlink(missing_ok=True)
    at_once = min(settings.concurrent, len(numbers))
    leagues = {number: sweep.league(number) for number in numbers}
    share = cpu_share(max(league.training.runners for league in leagues.values()), at_once)
    threads = min(MAX_THREADS, max(1, (os.cpu_count() or 1) // at_once))
    plans = {
        number: {
            "league": league.model_dump(mode="json", by_alias=True),
            "interface": interface.model_dump(mode="json"),
            "plan": _plan(sweep, number, registry, share, threads),
        }
        for number, league in leagues.items()
    }
    placements = {number: placement(league.training, share) for number, league in leagues.items()}
    watch = Watch(sweep, settings.metric, progress)
    tuner = tune.Tuner(
        tune.with_resources(
            tune.with_parameters(SweepTrial, plans=plans, metric=settings.metric),
            lambda config: placements[config[TRIAL][NUMBER]],
        ),
        param_space={TRIAL: tune.grid_search([_shown(sweep, number) for number in numbers])},
        tune_config=tune.TuneConfig(
            scheduler=_scheduler(settings, leagues),
            max_concurrent_trials=at_once,
            trial_dirname_creator=lambda trial: sweep.trial(trial.config[TRIAL][NUMBER]).name,
        ),
        run_config=run_config(sweep.path, [watch], StopAtRest(watch)),
    )
    return {
        (number := result.config[TRIAL][NUMBER]): told(
            result.error, sweep.record.config.league, sweep.trial(number) / "error.txt"
        )
        for result in fit(tuner, watch.ask_to_end)
        if result.error is not None
    }


def _plan(sweep: Sweep, number: int, registry: Registry, share: float, threads: int) -> Plan:
    """A trial goes on from its newest checkpoint."""
    checkpoints = sweep.trial(number) / CHECKPOINTS
    checkpoints.mkdir(parents=True, exist_ok=True)
    start, newest = AFRESH, sweep.checkpoint(number)
    if newest is not None:
        steps, seconds = read_progress(newest)
        start = Start(newest, steps, 0, seconds)
    return Plan(start, checkpoints, sweep.end, registry.storage, cpus=share, threads=threads)


def _scheduler(settings: SweepConfig, leagues: Mapping[int, LeagueConfig]) -> TrialScheduler:
    if settings.asha is None:
        return FIFOScheduler()
    return ASHAScheduler(
        time_attr="steps",
        metric=settings.metric,
        mode=settings.mode,
        grace_period=settings.asha.grace_steps,
        reduction_factor=settings.asha.reduction_factor,
        # A trial that has used its whole budget ends by itself.
        max_t=max(league.training.steps for league in leagues.values()) + 1,
    )


def _shown(sweep: Sweep, number: int) -> dict[str, Any]:
    """A trial's number and settings, for TensorBoard's table of hyperparameters, which takes no lists."""
    settings = sweep.record.trials[number]
    simple = {name: value if isinstance(value, int | float | str) else str(value) for name, value in settings.items()}
    return {NUMBER: number} | simple


def _best(trials: list[TrialReport], settings: SweepConfig) -> TrialReport | None:
    sign = 1 if settings.mode == "max" else -1
    whole = [trial for trial in trials if trial.outcome is not None and not trial.outcome.ended_early]
    scored = {trial.number: sign * trial.score for trial in whole if trial.score is not None}
    return trials[max(scored, key=lambda number: scored[number])] if scored else None


def _publish(sweep: Sweep, number: int, interface: Interface, registry: Registry) -> VersionRow:
    checkpoint = sweep.checkpoint(number)
    assert checkpoint is not None, "a trial that has used its budget has saved"
    return publish(
        Checkpoint(
            checkpoint, source=f"{sweep.id}/{sweep.trial(number).name}/{checkpoint.name}", steps=int(checkpoint.name)
        ),
        registry=registry,
        config=sweep.league(number),
        interface=interface,
        parent=None,
        git_commit=sweep.record.git_commit,
    )


def _settings(sweep: Sweep) -> SweepConfig:
    assert sweep.record.config.sweep is not None
    return sweep.record.config.sweep
