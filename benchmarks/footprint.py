"""What do an idle server and a version cost, and is memory constant over many swaps?

A server with two replicas is idle: the memory of all its processes (PSS, which counts shared pages once) and their
processor time.

One replica behind HAProxy. A version with a network of 1 MB is requested by number for the first time, and again: the
difference is the time for finding it in the registry, verifying, loading and warming up. A killed replica restarts:
from the start of its process to its first acknowledgement. A hundred versions of the 2×256 network are held at once;
and versions are promoted in turn without room for versions that are not live, so that each of them is loaded again.
"""

import time
from collections.abc import Callable, Iterator
from statistics import median
from typing import Any

import httpx
import psutil

from benchmarks.harness import Quick, Target
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, promote, served
from benchmarks.processes import replica_processes
from league.registry.registry import Registry
from tests.support.waiting import until

LARGE = (448, 448)
"""Units of a network of 1 MB."""
TO_LOAD = 20.0
"""Milliseconds."""
TO_START = 3.0
"""Seconds."""
POLICIES, MORE = 100, 150.0
"""Maximum additional memory of this number of policies, in MB."""
IDLE = {"memory": 850, "processes": 12, "processor time": 60}
"""At most: in MB, number, and in milliseconds per second."""
SWAPS, GROWTH = 10_000, 2.0
"""Number, and percent."""
WARM = 0.1
"""Fraction of the swaps after which memory is first measured, when allocators have reached their size."""


def main(quick: Quick = False, swaps: int = SWAPS) -> Iterator[Target]:
    """Measure an idle server, time to load, time to start, and memory."""
    yield from _idling(5 if quick else 60)
    yield _loading(3 if quick else 20)
    yield _starting(1 if quick else 5)
    yield _holding(10 if quick else POLICIES)
    yield _swapping(100 if quick else swaps)


def _idling(seconds: int) -> Iterator[Target]:
    with served(replicas=2):
        time.sleep(seconds)  # what the start has left to do
        before = _processor_times()
        time.sleep(seconds)
        after = _processor_times()
        memory = sum(process.memory_full_info().pss for process in after)
    spent = sum(after[process] - before[process] for process in before.keys() & after.keys())
    for name, value, unit in (
        ("memory", round(memory / 1e6), "MB"),
        ("processes", len(after), ""),
        ("processor time", round(1e3 * spent / seconds, 1), "ms/s"),
    ):
        yield Target(f"{name} of an idle server", value, unit, at_most=IDLE[name])


def _processor_times() -> dict[psutil.Process, float]:
    """The seconds of processor time of each process of the server."""
    times = {process: process.cpu_times() for process in psutil.Process().children(recursive=True)}
    return {process: spent.user + spent.system for process, spent in times.items()}


def _loading(times: int) -> Target:
    with served(times + 1, hidden=LARGE, replicas=1) as (url, registry):
        size = (registry.artifacts.path(LEAGUE, 1) / "shared.onnx").stat().st_size / 1e6
        loads = []
        with httpx.Client(base_url=url) as client:
            for number in range(2, times + 2):
                first, again = _act(client, number), min(_act(client, number) for _ in range(3))
                loads.append((first - again) * 1e3)
    note = f"{size:.2f} MB, longest {max(loads):.1f} ms"
    return Target(
        "first request for a version, minus the second", round(median(loads), 1), "ms", None, TO_LOAD, note=note
    )


def _act(client: httpx.Client, number: int) -> float:
    start = time.perf_counter()
    client.post(f"{ACTION}?version={number}", content=BODY).raise_for_status()
    return time.perf_counter() - start


def _starting(times: int) -> Target:
    seconds = []
    with served(replicas=1) as (_, registry):
        for _ in range(times):
            (old,) = replica_processes()
            before = _acknowledged(registry)
            old.kill()
            until(lambda known=before: _acknowledged(registry) - known, 60)
            seconds.append(time.time() - max(process.create_time() for process in replica_processes()))
    note = f"longest {max(seconds):.2f} s"
    return Target(
        "start of a replica's process to its first acknowledgement",
        round(median(seconds), 2),
        "s",
        None,
        TO_START,
        note=note,
    )


def _acknowledged(registry: Registry) -> set[str]:
    return {row.replica for row in registry.replicas.acknowledgements(LEAGUE)}


def _holding(policies: int) -> Target:
    with (
        served(policies, change=_settings(cached_versions=policies), replicas=1) as (url, _),
        httpx.Client(base_url=url) as client,
    ):
        (replica,) = replica_processes()
        _act(client, 1)
        before = _resident(replica)
        for number in range(1, policies + 1):
            _act(client, number)
        more = _resident(replica) - before
    return Target(
        f"{policies} policies in a replica", round(more), "MB", None, MORE, peer="one", note=f"{before:.0f} MB with one"
    )


def _swapping(swaps: int) -> Target:
    with served(4, change=_settings(cached_versions=1, poll=0.002), replicas=1) as (_, registry):
        (replica,) = replica_processes()
        sizes, start = [], time.monotonic()
        for number in range(1, swaps + 1):
            version = 1 + number % 4
            promote(registry, version)
            until(lambda v=version: any(row.version == v for row in registry.replicas.acknowledgements(LEAGUE)), 30)
            if number in (int(swaps * WARM), swaps):
                sizes.append(_resident(replica))
        rate = swaps / (time.monotonic() - start)
    growth = 100 * (sizes[1] / sizes[0] - 1)
    note = f"{swaps:,} swaps at {rate:.0f}/s, {sizes[0]:.1f} to {sizes[1]:.1f} MB"
    return Target("growth of memory over swaps", round(growth, 1), "%", None, GROWTH, note=note)


def _settings(**settings: float) -> Callable[[dict[str, Any]], object]:
    """A change of the settings of replicas in deploy.yaml."""
    return lambda document: document["applications"][0]["args"].update(settings)


def _resident(process: psutil.Process) -> float:
    """Resident memory in MB."""
    return float(process.memory_info().rss) / 1e6
