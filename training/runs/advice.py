"""Says what to change in a run that leaves a resource idle."""

import math
from collections.abc import Mapping

from league.config.ppo import PPOConfig
from league.config.training import TrainingSettings
from training.algorithms.resources import Resources

LEAST_SECONDS = 30.0
"""Shorter training says little about a longer one."""
MUCH, LITTLE = 0.25, 0.05
"""Shares of the learner's time that it waits for samples."""
IDLE = 0.5
"""Share of the time from which runners, or a GPU, count as idle."""
GUIDE = "docs/limits.md"


def idle_share(seconds: Mapping[str, float]) -> float | None:
    """Return the share of the runners' time in which they were idle; None without runners. seconds: of each phase."""
    idle, sampling = (seconds.get(f"time/runners_{name}", 0.0) for name in ("idle", "sampling"))
    return idle / (idle + sampling) if idle + sampling else None


def advice(
    seconds: Mapping[str, float], used: Resources, settings: TrainingSettings, cores: int, gpu_use: float | None
) -> str | None:
    """Return what to change, in one line; None if no resource is idle, or if training was short.

    Args:
        seconds: Seconds of each phase, see `training.algorithms.metrics`.
        used: What the run uses.
        settings: Its training settings.
        cores: Number of cores of all nodes.
        gpu_use: Mean utilisation of the learner's GPU, in [0, 1]; None if unknown.
    """
    learner = {name: value for name, value in seconds.items() if not name.startswith("time/runners_")}
    total = sum(learner.values())
    if total < LEAST_SECONDS:
        return None
    sampling, waiting = (learner.get(f"time/{name}", 0.0) / total for name in ("sampling", "waiting"))
    idle = idle_share(seconds)
    if idle is None:
        if sampling < IDLE or cores == 1:
            return None
        return f"The learner's process samples for {sampling:.0%} of the time: `runners` would sample on other cores."
    waits = f"The learner waits {waiting:.0%} of the time, {_runners(used.runners)} idle {idle:.0%}"
    if waiting >= MUCH and idle >= MUCH and isinstance(settings, PPOConfig) and settings.lag == 0:
        return f"{waits}: with `lag: 1` they overlap."
    if waiting >= MUCH and idle < MUCH:
        more = "more `runners`" if used.runners + used.threads < cores else "more cores"
        return f"{waits}: sampling limits the run. Use {more}, or make steps cheaper ({GUIDE}#mostly-sampling)."
    if waiting <= LITTLE and idle >= IDLE:
        enough = math.ceil(used.runners * (1 - idle) / (1 - MUCH))
        fewer = f"`runners: {enough}` is enough. " if enough < used.runners else ""
        return f"{waits}: learning limits the run. {fewer}{_faster_learning(gpu_use)} ({GUIDE}#mostly-learning)."
    return None


def _runners(count: int) -> str:
    return "its runner is" if count == 1 else f"its {count} runners are"


def _faster_learning(gpu_use: float | None) -> str:
    if gpu_use is None:
        return "Use fewer epochs, larger minibatches or a smaller network"
    if gpu_use < IDLE:
        return f"The GPU is used {gpu_use:.0%}: larger minibatches use more of it"
    return "Use fewer epochs or a smaller network"
