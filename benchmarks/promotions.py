"""What does a promotion cost clients, and how soon does it reach all replicas?

The champion alternates between two versions, moved like by `league promote`, each time as soon as all replicas have
acknowledged the previous one.

First with clients that send requests without pause and without retries: the number of failed requests, of requests sent
after all replicas had acknowledged a version but answered by another one, and of new HAProxy processes (a reload starts
one), and the time from the promoting call until all replicas have acknowledged. Then at half of the maximum rate of the
server: the 99th percentile of the latency with promotions divided by that without, in successive pairs of runs, of
which the median counts.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np
import orjson
from numpy.typing import NDArray

from benchmarks.leagues.served_league import BODY, LEAGUE, publish
from benchmarks.load.http import Load, drive, measure
from benchmarks.processes import haproxy_processes
from league.registry.registry import Registry
from serve_app.runtime.launch import running

ROOT = Path(__file__).parent.parent
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
    returned: float
    everywhere: float


def main() -> int:
    """Print the counts; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--promotions", type=int, default=1_000)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0, help="seconds of each run at half the rate")
    parser.add_argument("--quick", action="store_true", help="smoke test: 20 promotions, one short pair")
    parser.add_argument("--load", nargs=2, metavar=("URL", "FILE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.load:
        _load(*options.load)
        return 0
    count, pairs, seconds = (20, 1, 2.0) if options.quick else (options.promotions, options.pairs, options.seconds)
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch) / "home", versions=2)
        replies = Path(scratch) / "replies.npy"
        with running(registry.storage, replicas=REPLICAS) as url:
            _await_replicas(registry, 1)
            before, started = _settled(), set[int]()
            with _loading(url, replies):
                promotions = []
                for i in range(count):
                    promotions.append(_promote(registry, 2 - i % 2))
                    started |= haproxy_processes() - before
            met = [_report(promotions, np.load(replies), len(started), None if options.quick else REQUESTS)]
            met.append(_pairs(url, registry, pairs, seconds))
        registry.close()
    return int(not all(met))


def _report(promotions: list[MeasuredPromotion], replies: NDArray, reloads: int, enough: int | None) -> bool:
    """replies: (n, 3): time of sending, time of the answer, and its version, 0 without one."""
    sent, answered, version = replies.T
    failed = int((version == 0).sum())
    wrong = sum(
        int(((sent > now.everywhere) & (answered < then.start) & (version != now.version) & (version != 0)).sum())
        for now, then in pairwise(promotions)
    )
    reached = np.array([promotion.everywhere - promotion.start for promotion in promotions])
    p99 = float(np.percentile(reached, 99))
    seconds = answered.max() - sent.min()
    print(f"{len(promotions)} promotions, {CLIENTS} clients, {REPLICAS} replicas: {len(replies):,} requests, ", end="")
    print(f"{len(replies) / seconds:,.0f}/s" + (f"   (at least {enough:,} requests)" if enough else ""))
    print(f"failed requests: {failed}   (at most 0)")
    print(f"answered by a version that was replaced everywhere: {wrong}   (at most 0)")
    print(f"reloads of HAProxy: {reloads}   (at most 0)")
    print(f"promotion → every replica: median {np.median(reached):.3f} s, p99 {p99:.3f} s, ", end="")
    print(f"longest {reached.max():.3f} s   (p99 at most {TARGET:g} s)")
    return not failed + wrong + reloads and p99 <= TARGET and len(replies) >= (enough or 0)


def _pairs(url: str, registry: Registry, pairs: int, seconds: float) -> bool:
    address = f"{url}/v1/policies/{LEAGUE}/action"
    rate = measure(address, BODY, connections=32, seconds=seconds / 2).rate / 2
    ratios = []
    for number in range(pairs):
        steady = measure(address, BODY, connections=CLIENTS, seconds=seconds, rate=rate)
        with _promoting(registry) as promotions:
            moving = measure(address, BODY, connections=CLIENTS, seconds=seconds, rate=rate)
        ratios.append(moving.p99 / steady.p99)
        print(f"pair {number + 1}, {rate:,.0f}/s: {_format(steady)} without, ", end="")
        print(f"{_format(moving)} with {len(promotions)} promotions: {ratios[-1]:.2f}×", flush=True)
    print(f"p99 with promotions over without: {median(ratios):.2f}×   (at most {SLOWER:g}×)")
    return median(ratios) <= SLOWER


def _format(load: Load) -> str:
    failed = f", {load.failed} failed" if load.failed else ""
    return f"p50 {load.p50:.2f} ms, p99 {load.p99:.2f} ms{failed}"


@contextmanager
def _promoting(registry: Registry) -> Iterator[list[MeasuredPromotion]]:
    """Promote continuously while the context lasts."""
    promotions: list[MeasuredPromotion] = []
    is_over = threading.Event()

    def promote() -> None:
        # Usually the promoting process runs elsewhere: here it uses only the CPU time that others leave.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 15)
        while not is_over.is_set():
            promotions.append(_promote(registry, 3 - registry.aliases.current(LEAGUE)["champion"], every=0.05))

    thread = threading.Thread(target=promote)
    thread.start()
    try:
        yield promotions
    finally:
        is_over.set()
        thread.join()


def _promote(registry: Registry, version: int, every: float = 0.005) -> MeasuredPromotion:
    """Move the champion and wait for all replicas, polling at this interval in seconds."""
    start = time.perf_counter()
    expected = registry.aliases.current(LEAGUE)["champion"]
    registry.aliases.set(LEAGUE, "champion", version, expected=expected, actor="benchmark", reason="back and forth")
    returned = time.perf_counter()
    _await_replicas(registry, version, every)
    return MeasuredPromotion(version, start, returned, time.perf_counter())


def _await_replicas(registry: Registry, version: int, every: float = 0.005) -> None:
    """Return when all replicas have acknowledged a version."""
    deadline = time.monotonic() + 30
    while sum(row.version == version for row in registry.replicas.acknowledgements(LEAGUE)) < REPLICAS:
        if time.monotonic() > deadline:
            raise TimeoutError(f"version {version} did not reach every replica within 30 s")
        time.sleep(every)


def _settled(seconds: float = 3.0) -> set[int]:
    """HAProxy's processes, once they have not changed for a while: a new replica causes a reload, too."""
    known, since = haproxy_processes(), time.monotonic()
    while time.monotonic() < since + seconds:
        time.sleep(0.1)
        if (now := haproxy_processes()) != known:
            known, since = now, time.monotonic()
    return known


@contextmanager
def _loading(url: str, replies: Path) -> Iterator[None]:
    """Request actions in a subprocess while the context lasts; the replies are in the file afterwards."""
    command = [sys.executable, "-m", "benchmarks.promotions", "--load", url, str(replies)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as load:
        assert load.stdin is not None
        assert load.stdout is not None
        load.stdout.readline()  # the first reply
        try:
            yield
        finally:
            load.stdin.close()


def _load(url: str, file: str) -> None:
    """Send requests until standard input is closed."""
    import threading

    import uvloop

    stop = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
    replies: list[tuple[float, float, int]] = []

    def on_reply(status: int, body: bytes, sent_at: float) -> bool:
        if not replies:
            print("answered", flush=True)
        replies.append((sent_at, time.perf_counter(), orjson.loads(body)["version"] if status == 200 else 0))
        return not stop.is_set()

    address = f"{url}/v1/policies/{LEAGUE}/action"
    uvloop.run(drive(address, BODY, CLIENTS, on_reply, lambda: not stop.is_set()))
    np.save(file, np.array(replies))


if __name__ == "__main__":
    sys.exit(main())
