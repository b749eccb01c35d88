"""Runs trials with Ray Tune: resources, experiment configuration, and graceful interrupts."""

import math
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ray import tune

from league.config.training import TrainingSettings
from league.errors import ConfigError
from league.ray_cluster import has_autoscaler, node_resources
from training.rllib_compat import restored_sigusr1
from training.runs.run_reporter import TensorBoard

MIN_CPU_SHARE = 0.05
"""Minimum CPU share of a process; at most twenty processes share a CPU."""


def cpu_share(runners: int, at_once: int = 1) -> float:
    """Return the CPUs of the learner and of each runner: one, or less if there are fewer.

    They take turns, so that a few more of them than CPUs do not overload a machine. at_once: number of concurrent
    trials. Raises ConfigError if there are far too many. If Ray's autoscaler adds nodes, each gets one.
    """
    if has_autoscaler():
        return 1.0
    nodes, count = [node.get("CPU", 0.0) for node in node_resources()], at_once * (1 + runners)
    # The largest share of which the nodes have enough is a whole part of one of them.
    shares = {math.floor(100 * min(1.0, cpus / parts)) for cpus in nodes for parts in range(1, count + 1)}
    fitting = [share for share in shares if share and sum(100 * cpus // share for cpus in nodes) >= count]
    if (share := max(fitting, default=0) / 100) < MIN_CPU_SHARE:
        raise ConfigError(f"training.runners: {at_once * runners} runners are too many for {sum(nodes):g} CPUs")
    return share


def placement(settings: TrainingSettings, cpus: float) -> tune.PlacementGroupFactory:
    """Place the learner and each runner on any node that has what they need.

    cpus: of each. Raises ConfigError if no nodes have it, which Ray would wait for forever, unless its autoscaler adds
    nodes.
    """
    learner = settings.gpus + (settings.runner_gpus if settings.runners == 0 else 0)
    requested = requested_gpus(settings)
    available = sum(node.get("GPU", 0.0) for node in node_resources())
    if requested > available and not has_autoscaler():
        raise ConfigError(
            f"training.gpus, training.runner_gpus: {requested:g} GPUs requested in total, but Ray has {available:g}"
        )
    first, runner = ({"CPU": cpus} | _gpus(gpus) for gpus in (learner, settings.runner_gpus))
    if not has_autoscaler():
        _check_nodes(first, runner, settings.runners)
    return tune.PlacementGroupFactory([first] + [runner] * settings.runners)


def requested_gpus(settings: TrainingSettings) -> float:
    """Return the GPUs of the learner and of all runners."""
    return settings.gpus + max(settings.runners, 1) * settings.runner_gpus


def _check_nodes(learner: Mapping[str, float], runner: Mapping[str, float], runners: int) -> None:
    """Raise ConfigError unless the learner fits on one node, and the runners beside it and on the others."""
    nodes = node_resources()
    most = -1
    for place, node in enumerate(nodes):
        if all(node.get(name, 0.0) >= amount for name, amount in learner.items()):
            leftover = {name: node.get(name, 0.0) - learner.get(name, 0.0) for name in node}
            fitting = (
                min(math.floor(resources.get(name, 0.0) / amount + ROUNDING) for name, amount in runner.items())
                for resources in [*nodes[:place], leftover, *nodes[place + 1 :]]
            )
            most = max(most, sum(fitting))
    if most < runners:
        what = f"the learner needs {_listed(learner)}" if most < 0 else f"{runners} runners need {_listed(runner)} each"
        have = "; ".join(_listed({name: node.get(name, 0.0) for name in ("CPU", "GPU")}) for node in nodes)
        raise ConfigError(f"training: {what}, but the nodes of the Ray cluster have {have}")


def _listed(resources: Mapping[str, float]) -> str:
    return " and ".join(f"{amount:g} {name}s" for name, amount in resources.items())


def _gpus(count: float) -> dict[str, float]:
    return {"GPU": count} if count else {}


ROUNDING = 1e-9
"""Rounding error of a quotient of resources, which Ray counts in units of 0.0001."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Training was interrupted, and its state is saved. The message says what was published and how to continue.

    A KeyboardInterrupt, so that callers which do not handle it end, too.
    """


@contextmanager
def graceful_interrupt(ask: Callable[[], None]) -> Iterator[None]:
    """Call `ask` at the first SIGINT or SIGTERM, and raise KeyboardInterrupt at the next.

    Does nothing outside the main thread, where Python cannot handle signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    is_interrupted = False

    def handle(*_: Any) -> None:
        nonlocal is_interrupted
        if is_interrupted:
            raise KeyboardInterrupt
        is_interrupted = True
        ask()

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_config(path: Path, callbacks: list[tune.Callback], stop: tune.Stopper) -> tune.RunConfig:
    """Configure an experiment in the directory `path` with TensorBoard. Tune does not manage its checkpoints."""
    return tune.RunConfig(
        name=path.name,
        storage_path=str(path.parent),
        callbacks=[*callbacks, TensorBoard()],
        stop=stop,
        checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),
        verbose=0,
    )


def fit(tuner: tune.Tuner, request_stop: Callable[[], None]) -> tune.ResultGrid:
    """Run the experiment. The first Ctrl-C calls `request_stop`; the second raises KeyboardInterrupt."""
    with restored_sigusr1(), graceful_interrupt(request_stop):
        return tuner.fit()
