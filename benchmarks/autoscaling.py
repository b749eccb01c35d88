"""Do replicas follow the load?

One replica gets a load, four times as much, and then the first again.

Printed: the time from the step up to the first answer of a second replica, the time from the step down until one is
gone, and the calls that were lost. Settings are those of deploy.yaml, except for a shorter `downscale_delay_s`. The
cost of a request is measured first; the first load needs a third of the target of one replica, and four times as much
exceeds it. Where it does not, since requests that wait together cost less than single ones, the load grows further, and
the time counts from the last step.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from benchmarks.harness import Quick, Target
from benchmarks.leagues.served_league import served
from benchmarks.load.elsewhere import Performance, beside
from benchmarks.load.steps import Steps, step
from benchmarks.processes import replica_processes
from league.registry.registry import Registry
from tests.support.waiting import until

APPEARED = 10.0
"""Seconds."""
FIRST, FACTOR = 1 / 3, 4
"""The first load as a share of the target load of a replica, and the step."""
TARGET = 0.6
"""As in deploy.yaml."""
DOWNSCALE_DELAY = 10.0
HIDDEN = (2048, 2048)
"""Units of the network. Inference dominates the cost of a request, which hence does not depend on the rate."""
LEAST = 4.0
"""The least of the rates, in requests per second, with which the cost of a request is measured."""
STEADY = 15.0
"""Seconds with a constant load."""
SHORTEST = 8.0
"""Seconds in which the cost of a request is measured, at least."""
PATIENCE, GROWTH = 30.0, 1.5
"""Seconds after which a load that started no second replica grows by this factor."""
DEADLINE = 240.0


@dataclass(frozen=True, slots=True)
class Following:
    """How replicas followed the load.

    Attributes:
        rates: First load and the load that needed a second replica, in requests per second.
        cost: Processor time of a request in seconds.
        started: Seconds from the step up until Ray had started the second replica, which then loads the program.
        appeared: Seconds from the step up to the first answer of the second replica.
        removed: Seconds from the step down until it was gone.
        record: What callers saw.
    """

    rates: tuple[float, float]
    cost: float
    started: float
    appeared: float
    removed: float
    record: Steps


def main(quick: Quick = False) -> Iterator[Target]:
    """Step the load up and down."""
    following = follow(5.0 if quick else STEADY)
    record, (low, high) = following.record, following.rates
    note = f"{low:,.0f} to {high:,.0f} requests/s; Ray started it after {following.started:.1f} s"
    yield Target("step up: second replica answers", round(following.appeared, 1), "s", at_most=APPEARED, note=note)
    yield Target("step down: second replica gone", round(following.removed, 1), "s")
    note = f"of {record.calls:,}, longest {record.longest:.2f} s {'; '.join(record.lost)}".strip()
    yield Target("calls of the client lost", len(record.lost), at_most=0, note=note)
    yield Target("single attempts failed", sum(record.statuses.values()), note=f"of {record.attempts:,}")


def follow(steady: float, target: float = TARGET, first: float = FIRST, factor: float = FACTOR) -> Following:
    """Serve, and step the load up and down.

    steady: seconds of each constant load. target: load that a replica should have, as a share of a core. first: the
    first load as a share of the target. factor: the step.

    Raises AssertionError if the number of replicas changes under a constant load, and TimeoutError if it does not
    follow a step.
    """
    change = partial(_change, target=target)
    with served(hidden=HIDDEN, change=change, replicas=1, max_replicas=2) as (url, registry):
        with beside(step, url) as load:
            cost = _cost(registry, load, max(steady, SHORTEST), target)
            rate = first * target / cost
            load.send(rate)
            _hold(registry, 1, steady)
            up, high = _step_up(registry, load, factor * rate)
            started = time.monotonic() - up
            until(lambda: _replicas(registry) == 2, DEADLINE)
            _hold(registry, 2, steady)
            down = time.monotonic()
            load.send(rate)
            until(lambda: _replicas(registry) == 1, DEADLINE)
            removed = time.monotonic() - down
            _hold(registry, 1, steady)
        appeared, *later = load.result.since(up)
        assert not later, "a second replica was added, removed, and added again"
    return Following((rate, high), cost, started, appeared, removed, load.result)


def _change(document: dict[str, Any], target: float) -> None:
    autoscaling = document["applications"][0]["deployments"][0]["autoscaling_config"]
    autoscaling["downscale_delay_s"] = DOWNSCALE_DELAY
    autoscaling["policy"]["policy_kwargs"]["target"] = target


def _cost(registry: Registry, load: Performance[Steps], seconds: float, target: float) -> float:
    """Processor time of a request in seconds, from a load that no machine needs a second replica for."""
    (replica,) = replica_processes(registry.storage.home)
    rate = LEAST
    load.send(rate)
    _busy(replica.cpu_times, seconds / 2)  # after the start, the program still loads what it rarely needs
    least = busy = _busy(replica.cpu_times, seconds)
    while busy - least < target / 8:
        rate *= 2
        load.send(rate)
        busy = _busy(replica.cpu_times, seconds)
    return (busy - least) / (rate - LEAST)


def _step_up(registry: Registry, load: Performance[Steps], rate: float) -> tuple[float, float]:
    """Raise the load until Ray has started a second replica. Returns the time of the last step, and its rate."""
    deadline = time.monotonic() + DEADLINE
    while True:
        up = time.monotonic()
        load.send(rate)
        try:
            until(lambda: len(replica_processes(registry.storage.home)) == 2, PATIENCE)
        except TimeoutError:
            if up > deadline:
                raise
            rate *= GROWTH
        else:
            return up, rate


def _busy(times: Callable[[], object], seconds: float) -> float:
    """Share of a core that a process uses."""
    before, at = _total(times()), time.monotonic()
    time.sleep(seconds)
    return (_total(times()) - before) / (time.monotonic() - at)


def _total(times: object) -> float:
    return float(times.user + times.system)  # type: ignore[attr-defined]


def _replicas(registry: Registry) -> int:
    """Replicas that follow the registry."""
    return len(registry.replicas.registered())


def _hold(registry: Registry, number: int, seconds: float) -> None:
    """Wait, and check the number of replicas."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        assert _replicas(registry) == number, f"{_replicas(registry)} replicas under a constant load, not {number}"
        time.sleep(0.05)
