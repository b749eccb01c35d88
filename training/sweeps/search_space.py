"""Decides the settings of a sweep's trials, in Ray Tune's search spaces.

random: all combinations of lists, with samples of distributions. The same configuration gives the same trials: samples
derive from `training.seed`. All are known before the first one starts, so that all are checked.

optuna: each trial from the results of those before it (Bergstra et al., "Algorithms for Hyper-Parameter Optimization",
2011). A proposal depends on `training.seed`, the trial's number and the recorded trials only. There is no other state,
so that a resumed sweep continues as the interrupted one would have.
"""

import math
import warnings
from collections.abc import Sequence
from typing import Any

from ray import tune
from ray.tune.search.optuna import OptunaSearch

from league.config.league import LeagueConfig
from league.config.sweep import SweepConfig
from league.errors import ConfigError
from league.frozen import FrozenModel
from league.random.seeds import derive, generator
from training.rllib_compat import generate_variants

Settings = dict[str, Any]
"""Training setting, with dots for nested ones (`per_policy.cars.lr`) → value."""

DIGITS = 4
"""Significant digits of numbers in tables and messages."""
DISTRIBUTIONS = {
    "choice": "[value, …]",
    "uniform": "[low, high] with low < high",
    "quniform": "[low, high, step] with low < high",
    "loguniform": "[low, high] with 0 < low < high",
    "qloguniform": "[low, high, step] with 0 < low < high",
    "randn": "[mean, deviation]",
    "qrandn": "[mean, deviation, step]",
    "randint": "[low, high] in whole numbers with low < high",
    "qrandint": "[low, high, step] in whole numbers with low < high",
    "lograndint": "[low, high] in whole numbers with 0 < low < high",
    "qlograndint": "[low, high, step] in whole numbers with 0 < low < high",
}
"""Distribution of Ray Tune → its arguments."""
RANDOM_ONLY = {"randn", "qrandn", "qloguniform", "qlograndint"}
"""Distributions that Optuna lacks."""


class TrialOutcome(FrozenModel, allow_inf_nan=False):
    """The result of a trial.

    score: the mean metric of its last reports, or its last strength; None without values. low, high: the bounds of the
    strength's 95 % interval.
    """

    score: float | None
    low: float | None = None
    high: float | None = None
    steps: int
    seconds: float
    ended_early: bool
    """By the scheduler, because other trials were better."""


def plan(config: LeagueConfig, sweep: SweepConfig) -> list[Settings]:
    """Return the settings of each trial, in order. Raises ConfigError for an invalid parameter."""
    rng, space = generator(config.training.seed, "sweep"), _space(sweep)
    return [settings for _ in range(sweep.samples) for _, settings in generate_variants(space, random_state=rng)]


def propose(
    config: LeagueConfig, sweep: SweepConfig, trials: Sequence[tuple[Settings, TrialOutcome | None]], attempt: int = 0
) -> Settings:
    """Return the settings that Optuna proposes for the next trial.

    Args:
        config: The league, whose `training.seed` counts.
        sweep: The parameters, and whether the score is maximised.
        trials: All trials before, in order, with their outcomes; None of those that have not ended.
        attempt: Number of proposals for this trial that could not be used.

    Raises:
        ConfigError: Optuna is not installed; an invalid parameter.
    """
    try:
        import optuna
    except ModuleNotFoundError:
        raise ConfigError("sweep.search: optuna requires Optuna: pip install 'policy-league[optuna]'") from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    seed = derive(config.training.seed, "sweep", len(trials), attempt) % 2**32
    sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
    study = optuna.create_study(sampler=sampler, direction=f"{sweep.mode}imize")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Choices for a categorical distribution", UserWarning)  # may be lists
        distributions = OptunaSearch.convert_search_space(_space(sweep))
    for settings, outcome in trials:
        state, value, reports = optuna.trial.TrialState.RUNNING, None, {}
        if outcome is not None and outcome.score is None:
            state = optuna.trial.TrialState.FAIL
        elif outcome is not None and outcome.ended_early:
            state, reports = optuna.trial.TrialState.PRUNED, {outcome.steps: outcome.score}
        elif outcome is not None:
            state, value = optuna.trial.TrialState.COMPLETE, outcome.score
        trial = optuna.trial.create_trial(
            state=state, value=value, params=settings, distributions=distributions, intermediate_values=reports
        )
        study.add_trial(trial)
    return study.ask(distributions).params


def size(sweep: SweepConfig, trials: Sequence[Settings]) -> int:
    """Return the number of trials of a sweep, of which `trials` are known."""
    return sweep.samples if sweep.search == "optuna" else len(trials)


def _space(sweep: SweepConfig) -> dict[str, Any]:
    """Return parameter → Tune's domain, in order."""
    return {
        name: _domain(name, values, is_random=sweep.search == "random") for name, values in sweep.parameters.items()
    }


def _domain(name: str, values: Any, *, is_random: bool) -> Any:
    """Return Tune's domain for the values of a parameter."""
    place = f"sweep.parameters.{name}: expected"
    if isinstance(values, list):
        if not values:
            raise ConfigError(f"{place} at least one value, got {values!r}")
        return tune.grid_search(values) if is_random else tune.choice(values)
    kinds = [kind for kind in DISTRIBUTIONS if is_random or kind not in RANDOM_ONLY]
    if len(values) != 1 or next(iter(values)) not in kinds:
        by_optuna = "" if is_random else " with search: optuna"
        raise ConfigError(f"{place} a list of values, or one of {', '.join(kinds)}{by_optuna}, got {values!r}")
    ((kind, arguments),) = values.items()
    if not isinstance(arguments, list) or not _are_arguments(kind, arguments):
        raise ConfigError(f"{place} {kind}: {DISTRIBUTIONS[kind]}, got {values!r}")
    try:
        return tune.choice(arguments) if kind == "choice" else getattr(tune, kind)(*arguments)
    except ValueError as error:  # bounds that are not multiples of the step
        raise ConfigError(f"{place} {kind}: {DISTRIBUTIONS[kind]}, got {values!r}: {error}") from error


def _are_arguments(kind: str, arguments: list[Any]) -> bool:
    if kind == "choice":
        return bool(arguments)
    number = int if "randint" in kind else int | float
    if len(arguments) != 2 + kind.startswith("q"):
        return False
    if not all(isinstance(argument, number) and math.isfinite(argument) for argument in arguments):
        return False
    first, second, *step = arguments
    return ("randn" in kind or first < second) and ("log" not in kind or first > 0) and all(width > 0 for width in step)


def applied(config: LeagueConfig, settings: Settings) -> LeagueConfig:
    """Return the league with `settings`. Raises ConfigError for unknown or invalid ones."""
    return config.with_training(**nested(settings, config.training.model_dump(mode="json", by_alias=True)))


def nested(settings: Settings, document: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return settings as in a league's file: `{"per_policy.cars.lr": 1}` → `{"per_policy": {"cars": {"lr": 1}}}`.

    document: settings that these are added to, which are changed in place.
    """
    document = {} if document is None else document
    for name, value in settings.items():
        *path, last = name.split(".")
        part = document
        for key in path:
            if part.get(key) is None:
                part[key] = {}
            part = part[key]
            if not isinstance(part, dict):
                raise ConfigError(f"sweep.parameters.{name}: training.{key} has no nested settings")
        part[last] = value
    return document


def format_value(value: Any) -> str:
    """Format a setting, with a few digits of a number."""
    return str(float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value)


def format_settings(settings: Settings) -> str:
    """Format the settings of a trial: `lr 0.001, hidden [64, 64]`."""
    return ", ".join(f"{name} {format_value(value)}" for name, value in settings.items())
