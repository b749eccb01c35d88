"""What a trial takes of the cluster: CPUs and GPUs of its learner and of each of its runners."""

import ray
from ray import tune

from league.errors import ConfigError
from league.training_config import TrainingSettings

SMALLEST_SHARE = 0.05
"""Of a CPU. More processes than twenty on one do nothing but wait for one another."""


def cpu_share(runners: int, at_once: int = 1) -> float:
    """CPUs of the learner and of each of its runners: one, less where there are not as many.

    They take turns, so that a machine is not overloaded by a few more of them than it has CPUs.
    at_once: as many trials run together. Raises ConfigError if there are far too many.
    """
    cpus = ray.cluster_resources().get("CPU", 0.0)
    share = min(1.0, int(100 * cpus / (at_once * (1 + runners))) / 100)
    if share < SMALLEST_SHARE:
        raise ConfigError(f"training.runners: {at_once * runners} runners are too many for {cpus:g} CPUs")
    return share


def placement(settings: TrainingSettings, cpus: float) -> tune.PlacementGroupFactory:
    """The learner on the driver's machine, where checkpoints are read; each runner anywhere.

    cpus: of each. Raises ConfigError if it asks for more GPUs than there are: it would wait for ever.
    """
    learner = settings.gpus + (settings.runner_gpus if settings.runners == 0 else 0)
    asked, there = learner + settings.runners * settings.runner_gpus, ray.cluster_resources().get("GPU", 0.0)
    if asked > there:
        raise ConfigError(
            f"training.gpus, training.runner_gpus: {asked:g} GPUs are asked for in all, and Ray has {there:g}"
        )
    here = f"node:{ray.util.get_node_ip_address()}"
    runner = {"CPU": cpus} | _gpus(settings.runner_gpus)
    return tune.PlacementGroupFactory([{"CPU": cpus, here: 0.001} | _gpus(learner)] + [runner] * settings.runners)


def _gpus(count: float) -> dict[str, float]:
    return {"GPU": count} if count else {}
