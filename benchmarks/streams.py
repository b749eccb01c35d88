"""Many WebSocket streams: memory of an idle one, actions next to them, reconnections when a replica is removed.

memory     10,000 idle streams, connected to a replica without HAProxy, which needs two file descriptors for each; the
           memory of HAProxy for a stream is measured with fewer
actions    rate of actions through HAProxy, with these streams and without, in turn
reconnect  2,000 streams through HAProxy to three replicas, one of which is removed: all reconnect within two minutes;
           how many in the busiest second, and how many without a close frame
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

from benchmarks.leagues.served_league import BODY, LEAGUE, publish
from benchmarks.load import http
from benchmarks.load.idle_streams import IdleStreams, holding
from benchmarks.processes import haproxy_processes, replica_processes
from league.registry.registry import Registry
from serve_app.runtime.launch import DEPLOY_YAML, running
from tests.support.servers.scaling import scale
from tests.support.servers.under_load import RayServer
from tests.support.waiting import until

STREAMS, THROUGH_HAPROXY, RECONNECTING = 10_000, 4000, 2000
PAIRS, CONNECTIONS, SECONDS = 5, 8, 4.0
CUT = 130.0
"""Seconds after which HAProxy has ended all streams that were opened before a change of the replicas."""
REMOVED = 300.0
"""Seconds for a replica to be removed on a busy machine."""
MEMORY, RATE = 30.0, 0.9
"""Targets: kB per stream, rate of actions relative to that without streams."""
REPLICA_PORTS = range(30_000, 31_001)
"""Ports of replicas without HAProxy (RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT)."""
WARM_UP = 100
"""Streams that are opened and closed first, so that code is loaded before memory is measured."""
PARTS = ("memory", "reconnect")


def main() -> int:
    """Print the measurements; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smoke test: few streams, one pair of rates")
    parser.add_argument("--only", choices=PARTS, help="measure this part")
    options = parser.parse_args()
    met = True
    if options.only != "reconnect":
        met = _idle(*(500, 200, 1) if options.quick else (STREAMS, THROUGH_HAPROXY, PAIRS))
    if options.only != "memory":
        met &= _reconnect(100 if options.quick else RECONNECTING)
    return int(not met)


def _idle(number: int, through_haproxy: int, pairs: int) -> bool:
    with _served(replicas=1) as server:
        path = f"/v1/policies/{LEAGUE}"
        (replica,) = replica_processes()
        direct, action = f"{_own_url(replica)}{path}/stream", f"{server.url}{path}/action"
        with holding(direct, WARM_UP):
            pass
        with holding(f"{server.url}{path}/stream", WARM_UP):
            before = _resident(_haproxy())
            with holding(f"{server.url}{path}/stream", through_haproxy):
                haproxy = (_resident(_haproxy()) - before) / through_haproxy
        sizes, ratios = [], []
        for _ in range(pairs):
            alone, resident = _rate(action), _resident([replica])
            with holding(direct, number) as seen:
                sizes.append((_resident([replica]) - resident) / number)
                beside = _rate(action)
            assert not seen.codes, f"idle streams were closed: {seen.codes}"
            ratios.append(beside / ((alone + _rate(action)) / 2))
    memory, rate = sizes[0] / 1e3, median(ratios)
    print(f"{number:,} idle streams on a replica: {memory:.1f} kB each   (at most {MEMORY:g});", end="")
    print(f" in HAProxy {haproxy / 1e3:.1f} kB each, of {through_haproxy:,}")
    print(f"rate of actions next to them: {rate:.2f} times that without   (at least {RATE:g}); pairs ", end="")
    print(", ".join(f"{ratio:.2f}" for ratio in ratios), flush=True)
    return memory <= MEMORY and rate >= RATE


def _reconnect(number: int) -> bool:
    with _served(replicas=3) as server, holding(f"{server.url}/v1/policies/{LEAGUE}/stream", number) as seen:
        scale(server, 2)
        until(lambda: len(server.registry.replicas.registered()) == 2, REMOVED)
        time.sleep(CUT)
    _print_reconnections(number, seen)
    return seen.codes.get("none", 0) == 0


def _print_reconnections(number: int, seen: IdleStreams) -> None:
    per_second = Counter(int(at) for at in seen.closed)
    busiest = max(per_second.values(), default=0)
    print(f"one of three replicas removed, {number:,} streams: {len(seen.closed):,} closed", end="")
    if seen.closed:
        print(f" between {min(seen.closed):.0f} and {max(seen.closed):.0f} s", end="")
    print(
        f", at most {busiest} in one second; by close code {seen.codes}; {seen.refused} handshakes refused", flush=True
    )


def _rate(url: str) -> float:
    return http.measure(url, BODY, connections=CONNECTIONS, seconds=SECONDS).rate


def _own_url(replica: psutil.Process) -> str:
    """The URL of a replica without HAProxy."""
    listening = (found.laddr for found in replica.net_connections("tcp") if found.status == psutil.CONN_LISTEN)
    (port,) = {address.port for address in listening if address.port in REPLICA_PORTS}
    return f"http://127.0.0.1:{port}"


def _haproxy() -> list[psutil.Process]:
    return [psutil.Process(pid) for pid in haproxy_processes()]


def _resident(processes: list[psutil.Process]) -> int:
    return sum(process.memory_info().rss for process in processes)


@contextmanager
def _served(replicas: int) -> Iterator[RayServer]:
    with tempfile.TemporaryDirectory() as scratch:
        registry: Registry = publish(Path(scratch) / "home", versions=1)
        with running(registry.storage, replicas=replicas) as url:
            yield RayServer(url, "", registry, DEPLOY_YAML)
        registry.close()


if __name__ == "__main__":
    sys.exit(main())
