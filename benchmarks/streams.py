"""Many WebSocket streams: memory of an idle one, actions next to them, reconnections when a replica is removed.

idle       10,000 idle streams on a replica without HAProxy, which needs 2.5 file descriptors for each: memory of a
           stream, and the rate of actions with these streams and without, in turn
reconnect  streams through HAProxy to several replicas, one of which is removed: all reconnect within two minutes; how
           many in the busiest second, and how many without a close frame
"""

import time
from collections import Counter
from collections.abc import Iterator
from statistics import median
from typing import Annotated

import psutil
import typer

from benchmarks.harness import Parts, Quick, Target, chosen
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, published, served
from benchmarks.load import http
from benchmarks.load.elsewhere import beside
from benchmarks.load.idle_streams import IdleStreams, run
from benchmarks.registry.postgresql_replicas import standalone_replica
from serve_app.runtime.launch import DEPLOY_YAML
from tests.support.servers.scaling import scale
from tests.support.servers.under_load import RayServer
from tests.support.waiting import until

STREAM = f"/v1/policies/{LEAGUE}/stream"
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


def main(
    parts: Parts = None,
    quick: Quick = False,
    streams: Annotated[int, typer.Option(help="streams that reconnect")] = RECONNECTING,
    replicas: Annotated[int, typer.Option(help="replicas of which one is removed")] = REPLICAS,
) -> Iterator[Target]:
    """Measure the parts."""
    cases = {
        "idle": lambda: _idle(*(500, 1) if quick else (STREAMS, PAIRS)),
        "reconnect": lambda: _reconnect(100 if quick else streams, replicas),
    }
    for part in chosen(parts, cases).values():
        yield from part()


def _idle(number: int, pairs: int) -> Iterator[Target]:
    with published() as registry, standalone_replica(registry.storage, "idle") as replica:
        process = psutil.Process(replica.process.pid)
        with beside(run, replica.url + STREAM, WARM_UP):
            pass
        sizes, ratios = list[float](), list[float]()
        for _ in range(pairs):
            alone, resident = _rate(replica.url), process.memory_info().rss
            with beside(run, replica.url + STREAM, number) as outcome:
                sizes.append((process.memory_info().rss - resident) / number / 1e3)
                loaded = _rate(replica.url)
            assert not outcome.result.codes, f"idle streams were closed: {outcome.result.codes}"
            ratios.append(loaded / ((alone + _rate(replica.url)) / 2))
    yield Target("memory of an idle stream", round(max(sizes), 1), "kB", at_most=MEMORY, note=f"of {number:,}")
    yield Target("actions next to idle streams", median(ratios), "×", at_least=RATE, peer="without")


def _reconnect(number: int, replicas: int) -> Iterator[Target]:
    with served(replicas=replicas, timeout=STARTED) as (url, registry):
        server = RayServer(url, "", registry, DEPLOY_YAML)
        with beside(run, url + STREAM, number) as outcome:
            scale(server, replicas - 1)
            until(lambda: len(registry.replicas.registered()) == replicas - 1, REMOVED)
            time.sleep(CUT)
    streams: IdleStreams = outcome.result
    per_second = Counter(int(at) for at in streams.closed)
    note = f"{len(streams.closed):,} closed by code {streams.codes}"
    yield Target(
        "streams closed in the busiest second, replica removed", max(per_second.values(), default=0), note=note
    )
    yield Target("closed without a close frame", streams.codes.get("none", 0), at_most=0)
    yield Target("handshakes refused", streams.refused)


def _rate(url: str) -> float:
    return http.measure(url + ACTION, BODY, connections=CONNECTIONS, seconds=SECONDS).rate
