"""What does a promotion cost clients, and how soon does it reach all replicas?

The champion alternates between two versions, moved like by `league promote`, each time as soon as all replicas have
acknowledged the previous one.

First with clients that send requests without pause and without retries: the number of failed requests, of requests sent
after all replicas had acknowledged a version but answered by another one, and of new HAProxy processes (a reload starts
one), and the time from the promoting call until all replicas have acknowledged. Then at half of the maximum rate of the
server: the 99th percentile of the latency with promotions divided by that without, in successive pairs of runs, of
which the median counts.
"""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Annotated

import numpy as np
import orjson
import typer
from numpy.typing import NDArray

from benchmarks.harness import Quick, Target
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, promote, served
from benchmarks.load.elsewhere import Stage, beside
from benchmarks.load.http import drive, measure
from benchmarks.processes import haproxy_processes
from league.registry.registry import Registry
from tests.support.waiting import until

CLIENTS = 8
REPLICAS = 2
REQUESTS = 1_000_000
TARGET = 0.25
"""Seconds from a promotion until all replicas serve it, 99th percentile."""
SLOWER = 1.5
"""Maximum ratio to the latency without promotions, 99th percentile."""


@dataclass(frozen=True, slots=True)
class MeasuredPromotion:
    """One promotion. Times by `time.perf_counter`, which all processes of a machine share."""

    version: int
    start: float
    everywhere: float


def main(
    quick: Quick = False,
    promotions: int = 1_000,
    pairs: int = 5,
    seconds: Annotated[float, typer.Option(help="of each run at half the rate")] = 10.0,
) -> Iterator[Target]:
    """Promote under load."""
    count, pairs, seconds = (20, 1, 2.0) if quick else (promotions, pairs, seconds)
    with served(2, replicas=REPLICAS) as (url, registry):
        _await_replicas(registry, 1)
        before, reloaded = _settled(), set[int]()
        with beside(_load, url) as outcome:
            moves = []
            for i in range(count):
                moves.append(_promote(registry, 2 - i % 2))
                reloaded |= haproxy_processes() - before
        yield from _counts(moves, outcome.result, None if quick else REQUESTS)
        yield Target("reloads of HAProxy", len(reloaded), at_most=0)
        yield _pairs(url, registry, pairs, seconds)


def _counts(promotions: list[MeasuredPromotion], replies: NDArray, enough: int | None) -> Iterator[Target]:
    """replies: (n, 3): time of sending, time of the answer, and its version, 0 without one."""
    sent, answered, version = replies.T
    stale = sum(
        int(
            (
                (sent > current.everywhere)
                & (answered < following.start)
                & (version != current.version)
                & (version != 0)
            ).sum()
        )
        for current, following in pairwise(promotions)
    )
    note = f"{len(replies) / (answered.max() - sent.min()):,.0f}/s, {len(promotions)} promotions, {CLIENTS} clients"
    yield Target("requests", len(replies), at_least=enough, note=note)
    yield Target("requests that failed", int((version == 0).sum()), at_most=0)
    yield Target("answers by a version that was replaced everywhere", stale, at_most=0)
    reached = np.array([promotion.everywhere - promotion.start for promotion in promotions])
    note = f"median {np.median(reached):.3f} s, longest {reached.max():.3f} s"
    yield Target("promotion, p99", round(float(np.percentile(reached, 99)), 3), "s", at_most=TARGET, note=note)


def _pairs(url: str, registry: Registry, pairs: int, seconds: float) -> Target:
    rate = measure(url + ACTION, BODY, connections=32, seconds=seconds / 2).rate / 2
    ratios = []
    for _ in range(pairs):
        steady = measure(url + ACTION, BODY, connections=CLIENTS, seconds=seconds, rate=rate)
        with _promoting(registry):
            moving = measure(url + ACTION, BODY, connections=CLIENTS, seconds=seconds, rate=rate)
        ratios.append(moving.p99 / steady.p99)
    note = f"{rate:,.0f}/s; pairs {', '.join(f'{ratio:.2f}' for ratio in ratios)}"
    return Target("p99 of requests during promotions", median(ratios), "×", None, SLOWER, peer="without", note=note)


@contextmanager
def _promoting(registry: Registry) -> Iterator[None]:
    """Promote continuously while the context lasts."""
    is_over = threading.Event()

    def promote() -> None:
        # Usually the promoting process runs elsewhere: here it uses only the CPU time that others leave.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 15)
        while not is_over.is_set():
            _promote(registry, 3 - registry.aliases.current(LEAGUE)["champion"])
            time.sleep(0.05)

    thread = threading.Thread(target=promote)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def _promote(registry: Registry, version: int) -> MeasuredPromotion:
    """Move the champion and wait for all replicas."""
    start = time.perf_counter()
    promote(registry, version)
    _await_replicas(registry, version)
    return MeasuredPromotion(version, start, time.perf_counter())


def _await_replicas(registry: Registry, version: int) -> None:
    """Return when all replicas have acknowledged a version."""

    def acknowledged() -> bool:
        rows = registry.replicas.acknowledgements(LEAGUE)
        return sum(row.version == version for row in rows) >= REPLICAS

    until(acknowledged, 30)


def _settled(seconds: float = 3.0) -> set[int]:
    """HAProxy's processes, once they have not changed for a while: a new replica causes a reload, too."""
    processes, since = haproxy_processes(), time.monotonic()
    while time.monotonic() < since + seconds:
        time.sleep(0.1)
        if (current := haproxy_processes()) != processes:
            processes, since = current, time.monotonic()
    return processes


async def _load(stage: Stage, url: str) -> NDArray:
    """Send requests until the stage is over; returns the replies, see `_counts`."""
    replies: list[tuple[float, float, int]] = []

    def on_reply(status: int, body: bytes, sent_at: float) -> bool:
        if not replies:
            stage.ready()
        replies.append((sent_at, time.perf_counter(), orjson.loads(body)["version"] if status == 200 else 0))
        return not stage.is_over

    await drive(url + ACTION, BODY, CLIENTS, on_reply, lambda: not stage.is_over)
    return np.array(replies)
