"""Do replicas follow the load? One replica gets a load, four times as much, and then the first again.

Printed: the time from the step up to the first answer of a second replica, the time from the step down until one is
gone, and the calls that were lost. Settings are those of deploy.yaml, except for a shorter `downscale_delay_s`. The
cost of a request is measured first; the first load needs a third of the target of one replica, and four times as much
exceeds it.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import yaml

from benchmarks.leagues.served_league import publish
from benchmarks.load.steps import StepLoad, Steps, stepping
from benchmarks.processes import replica_processes
from league.registry.registry import Registry
from serve_app.runtime.launch import DEPLOY_YAML, running

APPEARED, LOST = 10.0, 0
"""Targets: seconds, calls of our client."""
FIRST, FACTOR = 1 / 3, 4
"""The first load as a share of the target load of a replica, and the step."""
TARGET = 0.6
"""As in deploy.yaml."""
DOWNSCALE_DELAY = 10.0
HIDDEN = (2048, 2048)
"""Units of the network. Inference dominates the cost of a request, which hence does not depend on the rate."""
SAMPLE = 30.0
"""The difference between the rates, in requests per second, with which the cost of a request is measured."""
STEADY = 15.0
"""Seconds with a constant load."""
SHORTEST = 8.0
"""Seconds in which the cost of a request is measured, at least."""
DEADLINE = 120.0


@dataclass(frozen=True, slots=True)
class Following:
    """How replicas followed the load.

    Attributes:
        rate: First load in requests per second.
        cost: Processor time of a request in seconds.
        started: Seconds from the step up until Ray had started the second replica, which then loads the program.
        appeared: Seconds from the step up to the first answer of the second replica.
        removed: Seconds from the step down until it was gone.
        seen: What callers saw.
    """

    rate: float
    cost: float
    started: float
    appeared: float
    removed: float
    seen: Steps


def main() -> int:
    """Print the measurements; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="short phases of constant load")
    found = follow(5.0 if parser.parse_args().quick else STEADY)
    seen, rate = found.seen, found.rate
    print(f"load: {rate:,.0f}, {FACTOR * rate:,.0f}, {rate:,.0f} requests/s, each {1e3 * found.cost:.2f} ms", end="")
    print(" of processor time")
    print(f"second replica answers after {found.appeared:.1f} s   (at most {APPEARED:g} s);", end="")
    print(f" Ray started it after {found.started:.1f} s")
    print(f"gone {found.removed:.1f} s after the step down, of which {DOWNSCALE_DELAY:g} s are `downscale_delay_s`")
    print(
        f"{len(seen.lost)} of {seen.calls:,} calls of the client lost   (at most {LOST}), longest {seen.longest:.2f} s;"
        f" {sum(seen.statuses.values())} of {seen.attempts:,} single attempts failed {seen.statuses or ''}"
    )
    for error in seen.lost:
        print(f"    {error}")
    return int(found.appeared > APPEARED or len(seen.lost) > LOST)


def follow(steady: float, target: float = TARGET, first: float = FIRST, factor: float = FACTOR) -> Following:
    """Serve, and step the load up and down.

    steady: seconds of each constant load. target: load that a replica should have, as a share of a core. first: the
    first load as a share of the target. factor: the step.

    Raises AssertionError if the number of replicas changes under a constant load, and TimeoutError if it does not
    follow a step.
    """
    with _served(target) as (url, registry):
        with stepping(url) as load:
            cost = _cost(registry, load, max(steady, SHORTEST))
            rate = first * target / cost
            load.set_rate(rate)
            _hold(registry, 1, steady)
            up = time.monotonic()
            load.set_rate(factor * rate)
            _await(lambda: len(replica_processes(registry.storage.home)), 2)
            started = time.monotonic() - up
            _await(lambda: _replicas(registry), 2)
            _hold(registry, 2, steady)
            down = time.monotonic()
            load.set_rate(rate)
            _await(lambda: _replicas(registry), 1)
            removed = time.monotonic() - down
            _hold(registry, 1, steady)
        appeared, *others = load.seen.since(up)
        assert not others, "a second replica was added, removed, and added again"
    return Following(rate, cost, started, appeared, removed, load.seen)


@contextmanager
def _served(target: float) -> Iterator[tuple[str, Registry]]:
    """The URL of one or two replicas, and their registry."""
    document = yaml.safe_load(DEPLOY_YAML.read_text())
    autoscaling = document["applications"][0]["deployments"][0]["autoscaling_config"]
    autoscaling["downscale_delay_s"] = DOWNSCALE_DELAY
    autoscaling["policy"]["policy_kwargs"]["target"] = target
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch) / "home", versions=1, hidden=HIDDEN)
        deploy = Path(scratch) / "deploy.yaml"
        deploy.write_text(yaml.safe_dump(document))
        with running(registry.storage, replicas=1, max_replicas=2, deploy=deploy) as url:
            yield url, registry
        registry.close()


def _cost(registry: Registry, load: StepLoad, seconds: float) -> float:
    """Processor time of a request in seconds."""
    (replica,) = replica_processes(registry.storage.home)
    load.set_rate(SAMPLE)
    _busy(replica.cpu_times, seconds / 2)  # after the start, the program still loads what it rarely needs
    once = _busy(replica.cpu_times, seconds)
    load.set_rate(2 * SAMPLE)
    return (_busy(replica.cpu_times, seconds) - once) / SAMPLE


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


def _await(replicas: Callable[[], int], number: int) -> None:
    """Wait for the number of replicas."""
    deadline = time.monotonic() + DEADLINE
    while replicas() != number:
        if time.monotonic() > deadline:
            raise TimeoutError(f"{replicas()} replicas after {DEADLINE:g} s, not {number}")
        time.sleep(0.05)


if __name__ == "__main__":
    sys.exit(main())
