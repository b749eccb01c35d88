"""Decides how many replicas a load needs.

Ray Serve runs `LoadPolicy`, which deploy.yaml names, at each turn of its controller's loop. Replicas report their load
(serve_app.observability.load), since Serve's own statistics do not contain requests that bypass it. Bounds and delays
are those of `autoscaling_config`. Serve copies this module to the controller by value: it imports only the standard
library.
"""

from collections.abc import Collection, Mapping
from math import ceil
from statistics import fmean
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ray.serve.config import AutoscalingContext

LOAD = "load"
"""The statistic of a replica that `LoadPolicy` reads."""
MARGIN = 0.2
"""Replicas are removed if the others would have at most this share less than the target load. It exceeds what a steady
load fluctuates by, so that no replica is removed and added in turn."""
STALE = 10.0
"""Seconds after which an unchanged statistic is unknown: replicas report twice a second."""


def required_replicas(loads: Collection[float | None], target: float, current: int, minimum: int, maximum: int) -> int:
    """Return the number of replicas that a load needs.

    Args:
        loads: Load of each running replica as a share of a core; None if it is unknown.
        target: Load that a replica should have.
        current: Number of replicas that run or start.
        minimum: Lower bound of the result.
        maximum: Upper bound of the result.

    A replica whose load is unknown needs no others, but none is removed meanwhile.
    """
    total = sum(load for load in loads if load is not None)
    replica_count = ceil(total / target)
    if replica_count <= current:
        is_complete = None not in loads
        replica_count = min(current, ceil(total / (target * (1 - MARGIN)))) if is_complete else current
    return min(max(replica_count, minimum, 1), maximum)


class LoadPolicy:
    """Ray Serve's autoscaling policy: `required_replicas`, with the mean load of `look_back_period_s`.

    target: the load that a replica should have, greater than 0 and less than 1. Raises ValueError.
    """

    def __init__(self, target: float) -> None:
        if not 0 < target < 1:
            raise ValueError(f"target must be greater than 0 and less than 1, got {target}")
        self._target = target

    def __call__(self, context: "AutoscalingContext") -> tuple[int, dict[str, Any]]:
        """Return the number of replicas, and when the statistics of each replica changed."""
        reported = (context.raw_metrics or {}).get(LOAD, {})
        changes: Mapping[str, tuple[float, float]] = context.policy_state.get("changes", {})
        current_time, loads, new_changes = (
            context.current_time or 0.0,
            list[float | None](),
            dict[str, tuple[float, float]](),
        )
        for replica in context.running_replicas:
            samples, name = reported.get(replica), replica.unique_id
            if not samples:
                loads.append(None)
                continue
            # The clock of the replica's node may differ from this one: only changes of its time stamps are compared.
            newest = samples[-1].timestamp
            last, changed_at = changes.get(name, (None, current_time))
            new_changes[name] = (newest, changed_at if last == newest else current_time)
            is_stale = current_time - new_changes[name][1] > STALE
            loads.append(None if is_stale else fmean(sample.value for sample in samples))
        replica_count = required_replicas(
            loads,
            self._target,
            context.target_num_replicas,
            context.capacity_adjusted_min_replicas,
            context.capacity_adjusted_max_replicas,
        )
        return replica_count, {"changes": new_changes}
