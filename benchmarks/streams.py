"""Many WebSocket streams: memory of an idle one, actions next to them, reconnections when a replica is removed.

idle       10,000 idle streams on a replica without HAProxy, which needs 2.5 file descriptors for each: memory of a
           stream, and the rate of actions with these streams and without, in turn
reconnect  streams through HAProxy to several replicas, one of which is removed: all reconnect within two minutes; how
           many in the busiest second, and how many without a close frame
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import psutil

from benchmarks.attacks.postgresql_leagues import standalone_replica
from benchmarks.leagues.served_league import BODY, LEAGUE, publish
from benchmarks.load import http
from benchmarks.load.idle_streams import IdleStreams, holding
from league.registry.registry import Registry
from serve_app.runtime.launch import DEPLOY_YAML, running
from tests.support.servers.scaling import scale
from tests.support.servers.under_load import RayServer
from tests.support.waiting import until

STREAMS, RECONNECTING, REPLICAS = 10_000, 2000, 3
PAIRS, CONNECTIONS, SECONDS = 5, 8, 4.0
CUT = 130.0
"""Seconds after which HAProxy has ended all streams that were opened before a change of the replicas."""
STARTED, REMOVED = 400.0, 300.0
"""Seconds for the replicas to start, and for one to be removed, on a busy machine."""
MEMORY, RATE = 30.0, 0.9
"""Targets: kB per stream, rate of actions relative to that without streams."""
WARM_UP = 100
"""Streams that are opened and closed first, so that code is loaded before memory is measured."""
PARTS = ("idle", "reconnect")


def main() -> int:
    """Print the measurements; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smoke test: few streams, one pair of rates")
    parser.add_argument("--only", choices=PARTS, help="measure this part")
    parser.add_argument("--streams", type=int, default=RECONNECTING, help="streams that reconnect")
    parser.add_argument("--replicas", type=int, default=REPLICAS, help="replicas of which one is removed")
    options = parser.parse_args()
    met = True
    if options.only != "reconnect":
        met = _idle(*(500, 1) if options.quick else (STREAMS, PAIRS))
    if options.only != "idle":
        met &= _reconnect(100 if options.quick else options.streams, options.replicas)
    return int(not met)


def _idle(number: int, pairs: int) -> bool:
    with _published() as registry, standalone_replica(registry.storage, "idle") as replica:
        path = f"{replica.url}/v1/policies/{LEAGUE}"
        stream, action = f"{path}/stream", f"{path}/action"
        process = psutil.Process(replica.process.pid)
        with holding(stream, WARM_UP):
            pass
        sizes, ratios = list[float](), list[float]()
        for _ in range(pairs):
            alone, resident = _rate(action), process.memory_info().rss
            with holding(stream, number) as seen:
                sizes.append((process.memory_info().rss - resident) / number / 1e3)
                beside = _rate(action)
            assert not seen.codes, f"idle streams were closed: {seen.codes}"
            ratios.append(beside / ((alone + _rate(action)) / 2))
    memory, rate = max(sizes), median(ratios)
    print(f"{number:,} idle streams on a replica: {memory:.1f} kB each   (at most {MEMORY:g})")
    print(f"rate of actions next to them: {rate:.2f} times that without   (at least {RATE:g}); pairs ", end="")
    print(", ".join(f"{ratio:.2f}" for ratio in ratios), flush=True)
    return memory <= MEMORY and rate >= RATE


def _reconnect(number: int, replicas: int) -> bool:
    with _served(replicas) as server, holding(f"{server.url}/v1/policies/{LEAGUE}/stream", number) as seen:
        scale(server, replicas - 1)
        until(lambda: len(server.registry.replicas.registered()) == replicas - 1, REMOVED)
        time.sleep(CUT)
    _print_reconnections(number, replicas, seen)
    return seen.codes.get("none", 0) == 0


def _print_reconnections(number: int, replicas: int, seen: IdleStreams) -> None:
    per_second = Counter(int(at) for at in seen.closed)
    busiest = max(per_second.values(), default=0)
    print(f"one of {replicas} replicas removed, {number:,} streams: {len(seen.closed):,} closed", end="")
    if seen.closed:
        print(f" between {min(seen.closed):.0f} and {max(seen.closed):.0f} s", end="")
    print(
        f", at most {busiest} in one second; by close code {seen.codes}; {seen.refused} handshakes refused", flush=True
    )


def _rate(url: str) -> float:
    return http.measure(url, BODY, connections=CONNECTIONS, seconds=SECONDS).rate


@contextmanager
def _published() -> Iterator[Registry]:
    with tempfile.TemporaryDirectory() as scratch:
        registry: Registry = publish(Path(scratch) / "home", versions=1)
        yield registry
        registry.close()


@contextmanager
def _served(replicas: int) -> Iterator[RayServer]:
    with _published() as registry, running(registry.storage, replicas=replicas, timeout=STARTED) as url:
        yield RayServer(url, "", registry, DEPLOY_YAML)


if __name__ == "__main__":
    sys.exit(main())
