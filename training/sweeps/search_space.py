"""Expands a sweep's parameters into trials: all combinations of its lists, with samples of its distributions.

The same configuration gives the same trials: samples derive from `training.seed` and the trial's number.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any

from league.config.league import LeagueConfig
from league.config.sweep import SweepConfig
from league.errors import ConfigError
from league.random.seeds import generator

Settings = dict[str, Any]
"""Training setting, with dots for nested ones (`per_policy.cars.lr`) → value."""

DIGITS = 4
"""Significant digits of sampled values, for readability."""


def plan(config: LeagueConfig, sweep: SweepConfig) -> list[Settings]:
    """Return the settings of each trial, in order. Raises ConfigError for an invalid parameter."""
    for name, values in sweep.parameters.items():
        if fault := _fault(values):
            raise ConfigError(f"sweep.parameters.{name}: {fault}, got {values!r}")
    lists = {name: values for name, values in sweep.parameters.items() if isinstance(values, list)}
    combinations = itertools.product(*lists.values())
    trials = [dict(zip(lists, values, strict=True)) for values in combinations for _ in range(sweep.samples)]
    for number, settings in enumerate(trials):
        rng = generator(config.training.seed, "sweep", number)
        for name, values in sweep.parameters.items():
            if not isinstance(values, dict):
                continue
            (kind, arguments), *_ = values.items()
            match kind:
                case "choice":
                    settings[name] = arguments[rng.integers(len(arguments))]
                case "randint":  # as in Ray Tune, without the upper bound
                    settings[name] = int(rng.integers(*arguments))
                case _:
                    low, high = arguments
                    ends = (math.log(low), math.log(high)) if kind == "loguniform" else (low, high)
                    drawn = rng.uniform(*ends)
                    value = math.exp(drawn) if kind == "loguniform" else drawn
                    settings[name] = min(max(float(f"{value:.{DIGITS}g}"), float(low)), float(high))
    return [{name: settings[name] for name in sweep.parameters} for settings in trials]


def applied(config: LeagueConfig, settings: Settings) -> LeagueConfig:
    """Return the league with `settings`. Raises ConfigError for unknown or invalid ones."""
    return config.with_training(**_nested(settings, config.training.model_dump(mode="json", by_alias=True)))


def nested(settings: Settings) -> dict[str, Any]:
    """Return settings as in a league's file: `{"per_policy.cars.lr": 1}` → `{"per_policy": {"cars": {"lr": 1}}}`."""
    return _nested(settings, {})


def _nested(settings: Settings, document: dict[str, Any]) -> dict[str, Any]:
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


def _fault(values: Any) -> str | None:
    if isinstance(values, list):
        return None if values else "expected at least one value"
    if len(values) != 1 or next(iter(values)) not in ("choice", "uniform", "loguniform", "randint"):
        return "expected a list of values, or one of choice, uniform, loguniform and randint"
    kind, arguments = next(iter(values.items()))
    if kind == "choice":
        return None if isinstance(arguments, list) and arguments else "expected choice: [value, …]"
    if not (
        isinstance(arguments, Sequence)
        and len(arguments) == 2
        and all(isinstance(bound, int | float) and math.isfinite(bound) for bound in arguments)
        and arguments[0] < arguments[1]
        and (kind != "loguniform" or arguments[0] > 0)
    ):
        least = "0 < low < high" if kind == "loguniform" else "low < high"
        return f"expected {kind}: [low, high] with {least}"
    if kind == "randint" and not all(isinstance(bound, int) for bound in arguments):
        return "expected randint: [low, high] in whole numbers"
    return None
