"""Measures the load of a replica, by which the number of replicas is decided (serve_app.runtime.autoscaling).

A replica computes on one core: its event loop handles requests, and large inferences run in threads. Three statistics,
none of which costs a request anything, show whether that core suffices:

    share of a core   processor time of the process
    queueing          time in which the event loop ran or waited for a processor: near 1, requests wait, even if
                      other programs leave the replica only a part of the core
    in progress       mean number of requests between arrival and response (Little's law): several if inferences
                      wait for each other in threads
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from serve_app.observability.metrics import Metrics

SCHEDULER_STATISTICS = Path("/proc/thread-self/schedstat")
SATURATED = 0.9
"""Share of time from which queueing counts as load. Below, other programs on the machine only delay the replica, and
another one would not help."""


@dataclass(frozen=True, slots=True)
class LoadSample:
    """The load of a replica in an interval.

    Attributes:
        cpu: Share of a core that the process used; more than 1 with threads.
        runnable: Share of the interval in which the event loop ran or waited for a processor.
        in_progress: Mean number of requests in progress.
        requests: api → requests that were answered.
    """

    cpu: float
    runnable: float
    in_progress: float
    requests: Mapping[str, int] = field(default_factory=dict)

    @property
    def load(self) -> float:
        """Share of the core that is needed."""
        # An M/M/1 queue holds ρ / (1 - ρ) requests on average if its server is busy for a share ρ.
        queueing = max(self.runnable, self.in_progress / (1 + self.in_progress))
        return max(self.cpu, queueing if queueing >= SATURATED else 0.0)


@dataclass(frozen=True, slots=True)
class _Totals:
    at: float
    cpu: float
    runnable: float
    requests: Mapping[str, tuple[int, int]]


class LoadSampler:
    """The load of this process between calls of `sample`, all in the thread of the event loop."""

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._last: _Totals | None = None

    def sample(self) -> LoadSample | None:
        """The load since the last call; None the first time."""
        totals = _Totals(time.monotonic(), time.process_time(), _runnable_seconds(), self._metrics.totals())
        last, self._last = self._last, totals
        if last is None:
            return None
        seconds = max(totals.at - last.at, 1e-3)
        # Counts of policies that were not used for long are dropped.
        counts = {api: max(count - last.requests.get(api, (0, 0))[0], 0) for api, (count, _) in totals.requests.items()}
        ns = sum(max(spent - last.requests.get(api, (0, 0))[1], 0) for api, (_, spent) in totals.requests.items())
        return LoadSample(
            (totals.cpu - last.cpu) / seconds, (totals.runnable - last.runnable) / seconds, ns / 1e9 / seconds, counts
        )


def _runnable_seconds() -> float:
    """Seconds in which this thread ran or waited for a processor; without Linux's statistics, those in which it ran."""
    try:
        ran, waited, _ = SCHEDULER_STATISTICS.read_text(encoding="ascii").split()
        return (int(ran) + int(waited)) / 1e9
    except (OSError, ValueError):
        return time.thread_time()
