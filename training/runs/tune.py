"""Runs trials with Ray Tune: resources, experiment configuration, and graceful interrupts."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray
from ray import tune

from league.config.training import TrainingSettings
from league.errors import ConfigError
from training.rllib_compat import restored_sigusr1
from training.runs.run_reporter import TensorBoard

MIN_CPU_SHARE = 0.05
"""Of a CPU: more than twenty processes per CPU only wait for one another."""


def cpu_share(runners: int, at_once: int = 1) -> float:
    """Return the CPUs of the learner and of each runner: one, or less if there are fewer.

    They take turns, so that a few more of them than CPUs do not overload a machine. at_once: number of concurrent
    trials. Raises ConfigError if there are far too many.
    """
    cpus = ray.cluster_resources().get("CPU", 0.0)
    share = min(1.0, int(100 * cpus / (at_once * (1 + runners))) / 100)
    if share < MIN_CPU_SHARE:
        raise ConfigError(f"training.runners: {at_once * runners} runners are too many for {cpus:g} CPUs")
    return share


def placement(settings: TrainingSettings, cpus: float) -> tune.PlacementGroupFactory:
    """Place the learner on the driver's machine, where checkpoints are read, and each runner anywhere.

    cpus: of each. Raises ConfigError for more GPUs than exist, which Ray would wait for forever.
    """
    learner = settings.gpus + (settings.runner_gpus if settings.runners == 0 else 0)
    requested, available = learner + settings.runners * settings.runner_gpus, ray.cluster_resources().get("GPU", 0.0)
    if requested > available:
        raise ConfigError(
            f"training.gpus, training.runner_gpus: {requested:g} GPUs requested in total, but Ray has {available:g}"
        )
    here = f"node:{ray.util.get_node_ip_address()}"
    runner = {"CPU": cpus} | _gpus(settings.runner_gpus)
    return tune.PlacementGroupFactory([{"CPU": cpus, here: 0.001} | _gpus(learner)] + [runner] * settings.runners)


def _gpus(count: float) -> dict[str, float]:
    return {"GPU": count} if count else {}


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
