"""How fast are searches served, and what do others see?

Connect four, 64 simulations with a 2×256 network, two replicas and the search service as deployed. One client, scaled
like the searches of `search`; 32 clients, whose peer is one core that only searches, one position at a time; the 99th
percentile of a plain version beside these 32, divided by that without them, in pairs of which the median counts;
requests for 10,000 simulations within 20 ms; and calls of the Python client while the processes of the search service
are killed.
"""

import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from statistics import median

import numpy as np
import orjson
import psutil

from benchmarks.harness import CONFIGS, Quick, Target, additions
from benchmarks.load.http import measure
from benchmarks.search import SECONDS
from benchmarks.search_strength import milliseconds
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.search.policies import publish_search, search_policies
from league.settings import Storage
from policy_league_client import Client
from serve_app.runtime.launch import running
from tests.support.leagues import tictactoe
from tests.support.policies.graphs import masked_mlp

LEAGUE = "connect_four"
PATH = f"/v1/policies/{LEAGUE}/action"
PLAIN, SEARCHED, SLOW = 1, 2, 3
MODEL = f"{LEAGUE}@{SEARCHED}"
SIMULATIONS, TOO_MANY = 64, 10_000
CLIENTS, ALONE_MS, OF_A_CORE, SLOWER, DEADLINE_MS, ANSWERED_MS = 32, 8.0, 0.6, 1.5, 20, 30.0
PLAIN_RATE = 100.0
"""Requests for the plain version per second: what it costs itself is no part of the ratio."""
PROCESS = "SearchService"
OBSERVATION = {"observation": np.zeros((6, 7, 2), np.int8).tolist(), "action_mask": [1] * 7}


def publish(home: Path) -> Registry:
    """A registry with a plain version and two that search with it, for a short and for a long time."""
    registry = Registry.open(Storage.at(home))
    config = LeagueConfig.load(CONFIGS / f"{LEAGUE}.yaml")
    registry.leagues.register(config, interface(config))
    graph, value = (masked_mlp(hidden=(256, 256), has_value=has_value) for has_value in (False, True))
    base = tictactoe.publish(registry, graph, LEAGUE, value=value)
    for simulations in (SIMULATIONS, TOO_MANY):
        publish_search(registry, base, config.environment, interface(config), "puct", simulations)
    return registry


def body(**options: int) -> bytes:
    """A request for one action."""
    return orjson.dumps({"observation": OBSERVATION, **options})


def main(quick: Quick = False, seconds: float = 10.0, pairs: int = 3) -> Iterator[Target]:
    """Measure everything on one server."""
    seconds, pairs = (1.0, 1) if quick else (seconds, pairs)
    with (
        tempfile.TemporaryDirectory() as scratch,
        closing(publish(Path(scratch) / "home")) as registry,
        running(registry.storage) as url,
    ):
        address = f"{url}{PATH}?version="
        with Client(url, timeout=60.0) as client:
            client.act(MODEL, OBSERVATION)  # starts the search service
        alone = measure(f"{address}{SEARCHED}", body(), connections=1, seconds=seconds)
        speed = additions()
        note = f"{alone.p50:.1f} ms, p99 {alone.p99:.1f} ms, {speed:.2f} s for the additions"
        yield Target("one client, p50", alone.p50 * SECONDS / speed, "ms", at_most=ALONE_MS, note=note)
        own_ms = _own_milliseconds(registry)
        many = measure(f"{address}{SEARCHED}", body(), connections=CLIENTS, seconds=seconds)
        note = (
            f"{many.rate:.0f}/s, p50 {many.p50:.1f} ms, {many.failed} failed; {own_ms:.1f} ms of processor time alone"
        )
        share, peer = many.rate * own_ms / 1000, "one core's own"
        yield Target(f"{CLIENTS} clients, searches per second", share, "×", at_least=OF_A_CORE, peer=peer, note=note)
        ratios = [_plain(address, seconds, True) / _plain(address, seconds, False) for _ in range(pairs)]
        note = f"{PLAIN_RATE:.0f}/s; pairs {', '.join(f'{ratio:.2f}' for ratio in ratios)}"
        yield Target("plain version beside, p99", median(ratios), "×", at_most=SLOWER, peer="alone", note=note)
        limited = measure(f"{address}{SLOW}", body(deadline_ms=DEADLINE_MS), connections=1, seconds=seconds)
        note = f"p50 {limited.p50:.1f} ms"
        name = f"{TOO_MANY:,} simulations in {DEADLINE_MS} ms, p99"
        yield Target(name, limited.p99, "ms", at_most=ANSWERED_MS, note=note)
        lost, longest, calls = _killed(url, 3 * seconds)
        note = f"of {calls:,}; longest call {longest:.1f} s"
        yield Target("calls lost to kills", lost, at_most=0, note=note)


def _own_milliseconds(registry: Registry) -> float:
    """Processor time of a search of one position in this process."""
    base, row = registry.versions.get(LEAGUE, PLAIN), registry.leagues.get(LEAGUE)
    policies = search_policies(base, "puct", SIMULATIONS, registry, row.interface, row.config.environment)
    return milliseconds(next(iter(policies.values())))


def _plain(address: str, seconds: float, beside: bool) -> float:
    """The 99th percentile of the plain version, in milliseconds."""
    searching = threading.Thread(
        target=measure,
        args=(f"{address}{SEARCHED}", body()),
        kwargs={"connections": CLIENTS, "seconds": seconds + 3},
    )
    if beside:
        searching.start()
        time.sleep(2)
    load = measure(f"{address}{PLAIN}", body(), connections=2, seconds=seconds, rate=PLAIN_RATE)
    if beside:
        searching.join()
    return load.p99


def _killed(url: str, seconds: float) -> tuple[int, float, int]:
    """Kill the search service every third of the time, under 8 clients; return lost calls, the longest one, and all."""
    end = time.monotonic() + seconds
    results: list[tuple[bool, float]] = []

    def call() -> None:
        with Client(url, timeout=60.0) as client:
            while time.monotonic() < end:
                began = time.monotonic()
                try:
                    client.act(MODEL, OBSERVATION)
                    results.append((True, time.monotonic() - began))
                except Exception:
                    results.append((False, time.monotonic() - began))

    clients = [threading.Thread(target=call) for _ in range(8)]
    for client in clients:
        client.start()
    for _ in range(2):
        time.sleep(seconds / 3)
        for process in psutil.process_iter(["cmdline", "name"]):
            if PROCESS in " ".join(process.info["cmdline"] or ()):
                os.kill(process.pid, signal.SIGKILL)
    for client in clients:
        client.join()
    return sum(not is_answered for is_answered, _ in results), max(took for _, took in results), len(results)
