"""Expands a sweep's parameters into trials with Ray Tune's search spaces: all combinations of lists, with samples of
distributions.

The same configuration gives the same trials: samples derive from `training.seed`. All trials are known before the first
one starts, so that all are checked, and an interrupted sweep continues with the same ones.
"""

import math
from typing import Any

from ray import tune

from league.config.league import LeagueConfig
from league.config.sweep import SweepConfig
from league.errors import ConfigError
from league.random.seeds import generator
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


def plan(config: LeagueConfig, sweep: SweepConfig) -> list[Settings]:
    """Return the settings of each trial, in order. Raises ConfigError for an invalid parameter."""
    space = {name: _domain(name, values) for name, values in sweep.parameters.items()}
    rng = generator(config.training.seed, "sweep")
    return [settings for _ in range(sweep.samples) for _, settings in generate_variants(space, random_state=rng)]


def _domain(name: str, values: Any) -> Any:
    """Return Tune's domain for the values of a parameter."""
    place = f"sweep.parameters.{name}: expected"
    if isinstance(values, list):
        if not values:
            raise ConfigError(f"{place} at least one value, got {values!r}")
        return tune.grid_search(values)
    if len(values) != 1 or next(iter(values)) not in DISTRIBUTIONS:
        raise ConfigError(f"{place} a list of values, or one of {', '.join(DISTRIBUTIONS)}, got {values!r}")
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
