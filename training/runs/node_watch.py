"""Watches the nodes of a cluster during a run: shows which of them it uses, and when it should move to others.

A run moves if a node that it uses is drained, or if nodes have joined with which its processes get more CPUs each. It
saves its state, which is published as a version, and continues from it: no step is repeated.
"""

import time
from collections.abc import Callable
from typing import Any

from ray import tune
from ray.exceptions import RpcError

from league.errors import ConfigError
from league.ray_cluster import draining_nodes, node_resources
from training.algorithms.resources import Resources
from training.rllib_compat import NotPickled
from training.runs.tune import cpu_share, requested_gpus

NODE_POLL = 1.0
"""Seconds."""


class NodeWatch(NotPickled, tune.Callback):
    """Watches during one attempt.

    share: CPUs of each learner and runner. say: prints a line. request_move: asks the trial to save and end;
    `reason` then says why.
    """

    def __init__(
        self, used: Resources, share: float, say: Callable[[str], None], request_move: Callable[[], None]
    ) -> None:
        self.reason: str | None = None
        self._processes, self._share, self._gpus = used.processes, share, requested_gpus(used)
        self._say, self._request_move = say, request_move
        self._nodes: frozenset[str] = frozenset()
        self._shown = ""
        self._next_look = 0.0

    def on_trial_result(self, *, result: dict[str, Any], **_: Any) -> None:
        self._nodes = frozenset(result["nodes"])
        self.on_step_begin()  # a short run may have no further step

    def on_step_begin(self, **_: Any) -> None:
        if not self._nodes or time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + NODE_POLL
        try:
            nodes = [node for node in node_resources() if node.get("CPU")]
            reason = self._reason_to_move() if self.reason is None else None
        except RpcError:  # the head is restarting
            return
        cpus, gpus = (sum(node.get(name, 0.0) for node in nodes) for name in ("CPU", "GPU"))
        used = f"{self._share * self._processes:g} of {cpus:g} CPUs"
        if self._gpus:
            used += f", {self._gpus:g} of {gpus:g} GPUs"
        status = f"Training on {len(self._nodes)} of {len(nodes)} nodes, {used}."
        if reason is not None:
            self.reason = reason
            self._request_move()
        elif self.reason is None and status != self._shown:
            self._shown = status
            self._say(status)

    def _reason_to_move(self) -> str | None:
        if leaving := self._nodes & draining_nodes():
            return f"{len(leaving)} of {len(self._nodes)} nodes are drained"
        try:
            return "nodes have joined" if cpu_share(self._processes) > self._share else None
        except ConfigError:  # nodes have left: Ray reports what was lost with them
            return None
