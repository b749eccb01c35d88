"""Runs trials with Ray Tune: resources, experiment configuration, and graceful interrupts."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from ray import tune

from league.errors import ConfigError
from league.interruption import on_ending_signals
from league.ray_cluster import has_autoscaler, node_resources
from training.algorithms.resources import Resources
from training.rllib_compat import restored_sigusr1
from training.runs.run_reporter import TensorBoard

MIN_CPU_SHARE = 0.05
"""Minimum CPU share of a process; at most twenty processes share a CPU."""


def cpu_share(processes: int, at_once: int = 1) -> float:
    """Return the CPUs of each learner and runner: one, or less if there are fewer.

    They take turns, so that a few more of them than CPUs do not overload a machine. processes: their number.
    at_once: number of concurrent trials. Raises ConfigError if there are far too many. If Ray's autoscaler adds nodes,
    each gets one.
    """
    if has_autoscaler():
        return 1.0
    nodes, count = [node.get("CPU", 0.0) for node in node_resources()], at_once * processes
    # The largest share of which the nodes have enough is a whole part of one of them.
    shares = {math.floor(100 * min(1.0, cpus / parts)) for cpus in nodes for parts in range(1, count + 1)}
    fitting = [share for share in shares if share and sum(100 * cpus // share for cpus in nodes) >= count]
    if (share := max(fitting, default=0) / 100) < MIN_CPU_SHARE:
        raise ConfigError(
            f"training.learners, training.runners: {count} processes are too many for {sum(nodes):g} CPUs"
        )
    return share


def placement(used: Resources, cpus: float) -> tune.PlacementGroupFactory:
    """Place each learner and runner on any node that has what they need.

    cpus: of each. Raises ConfigError for several learners without GPUs, or if no nodes have what is needed, which Ray
    would wait for forever, unless its autoscaler adds nodes.
    """
    if used.learners > 1 and not used.gpus:
        raise ConfigError(
            f"training.learners: expected 1, because the learner has no GPU (training.gpus is 0), got {used.learners}:"
            " on CPUs, several learners are slower than one"
        )
    gpus = used.gpus + (used.runner_gpus if used.runners == 0 else 0)
    first, further, runner = ({"CPU": cpus} | _gpus(count) for count in (gpus, used.gpus, used.runner_gpus))
    learners = [first] + [further] * (used.learners - 1)
    if not has_autoscaler():
        total = {name: sum(node.get(name, 0.0) for node in node_resources()) for name in ("CPU", "GPU")}
        if (requested := requested_gpus(used)) > total["GPU"]:
            names = "training.gpus, training.runner_gpus" if used.learners == 1 else "training.learners with gpus"
            raise ConfigError(f"{names}: {requested:g} GPUs requested in total, but Ray has {total['GPU']:g}")
        _check_nodes(learners, runner, used.runners)
    return tune.PlacementGroupFactory(learners + [runner] * used.runners)


def requested_gpus(used: Resources) -> float:
    """Return the GPUs of all learners and runners."""
    return used.learners * used.gpus + max(used.runners, 1) * used.runner_gpus


def _check_nodes(learners: Sequence[Mapping[str, float]], runner: Mapping[str, float], runners: int) -> None:
    """Raise ConfigError unless the learners fit on the nodes, filled from one of them on, and the runners beside."""
    nodes = node_resources()
    most = -1
    for place in range(len(nodes)):
        free = [dict(node) for node in nodes[place:] + nodes[:place]]
        if all(_take(free, learner) for learner in learners):
            most = max(most, sum(math.floor(_fitting(node, runner)) for node in free))
    if most < runners:
        needs = f"the learner needs {_listed(learners[0])}"
        if len(learners) > 1:
            needs = f"{len(learners)} learners need {_listed(learners[0])} each"
        what = needs if most < 0 else f"{runners} runners need {_listed(runner)} each"
        have = "; ".join(_listed({name: node.get(name, 0.0) for name in ("CPU", "GPU")}) for node in nodes)
        raise ConfigError(f"training: {what}, but the nodes of the Ray cluster have {have}")


def _take(nodes: Iterable[dict[str, float]], resources: Mapping[str, float]) -> bool:
    """Subtract resources from the first node that has them; return whether there is one."""
    for node in nodes:
        if _fitting(node, resources) >= 1:
            node.update({name: node[name] - amount for name, amount in resources.items()})
            return True
    return False


def _fitting(node: Mapping[str, float], resources: Mapping[str, float]) -> float:
    """Return how often resources fit on a node."""
    return min(node.get(name, 0.0) / amount + ROUNDING for name, amount in resources.items())


def _listed(resources: Mapping[str, float]) -> str:
    return " and ".join(f"{amount:g} {name}s" for name, amount in resources.items())


def _gpus(count: float) -> dict[str, float]:
    return {"GPU": count} if count else {}


ROUNDING = 1e-9
"""Rounding error of a quotient of resources, which Ray counts in units of 0.0001."""


class Interrupted(KeyboardInterrupt):
    """Training was interrupted, and its state is saved. The message says what was published and how to continue.

    A KeyboardInterrupt, so that callers which do not handle it end, too.
    """


@contextmanager
def graceful_interrupt(ask: Callable[[], None]) -> Iterator[None]:
    """Call `ask` at the first signal that ends a command, and raise KeyboardInterrupt at the next."""
    is_interrupted = False

    def handle() -> None:
        nonlocal is_interrupted
        if is_interrupted:
            raise KeyboardInterrupt
        is_interrupted = True
        ask()

    with on_ending_signals(handle):
        yield


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
