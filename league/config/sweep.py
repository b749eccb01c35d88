"""The `sweep` section: a search over training settings."""

from typing import Any, Literal

from pydantic import Field

from league.config.base import JSON, Part


class AshaConfig(Part):
    """Early stopping by asynchronous successive halving (Li et al., 2020, arXiv 1810.05934)."""

    grace_steps: int = Field(default=50_000, ge=1)
    """Minimum number of actions per trial."""
    reduction_factor: int = Field(default=3, ge=2)
    """At each rung, one in this many trials continues."""


class SweepConfig(Part):
    """Search over training settings (`league sweep`)."""

    parameters: dict[str, JSON | list[Any]] = Field(min_length=1)
    """Training setting → a list of values (grid search), or a distribution of Ray Tune with its arguments:
    `{choice: [..]}`, `{uniform: [low, high]}`, `{loguniform: [low, high]}`, `{randint: [low, high]}`, `{randn: [mean,
    deviation]}`, `{quniform: [low, high, step]}`, … Settings of one policy are `per_policy.<id>.<setting>`."""
    search: Literal["random", "optuna"] = "random"
    """What decides the settings of the trials. random: draws of the distributions for each combination of the lists.
    optuna: Optuna's TPE, from the results of the trials before; a list is a choice."""
    samples: int = Field(default=1, ge=1)
    """Samples of the random parameters for each combination of the lists; with `optuna`, the number of trials."""
    concurrent: int = Field(default=1, ge=1)
    """Maximum number of concurrent trials, also limited by the CPUs."""
    metric: str = "auto"
    """What trials are compared by: `strength`, the mean score against the champion and the anchors; or a metric of the
    run, such as `return` or `<policy>/return`. auto: `strength` in a league with two or more sides, else `return`."""
    mode: Literal["max", "min"] = "max"
    asha: AshaConfig | None = None
    """Early stopping; null trains each trial to its full budget."""
