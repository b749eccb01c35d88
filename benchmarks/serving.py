"""How fast is the action endpoint, compared with other policy servers and with the software it is built on?

All have a 2×256 network for connect four. Ours parses the board, checks board and mask, and answers with the legal
action, the version and its digest. Peers: a Serve application with the same settings that reads the same body and
answers with a constant; the same handler and model on uvicorn alone; FastAPI with torch on uvicorn; RLlib's example of
serving a policy, which reads a flat board and answers with the arg max. Servers run one at a time, in rounds; ratios
are computed within a round, and the medians over the rounds are reported. One replica each, unless stated otherwise. By
default Serve sends 5 concurrent requests to a replica and backs off beyond that: RLlib's example is measured with 5
connections, too, and its better rate counts. Processor time per answered request is that of all processes of a server;
it says nothing about waiting, but hardly depends on what else runs on the machine.

--peers compares with LitServe, MLServer and BentoML instead, one worker each, next to FastAPI. They run our graph with
ONNX Runtime, answer with the action only, and are installed into a cache folder.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from math import nan
from pathlib import Path
from statistics import median
from typing import Annotated

import httpx
import psutil
import typer
import yaml

from benchmarks.harness import ROOT, Quick, Target
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, PLANES, published
from benchmarks.load.http import measure
from benchmarks.peers.frameworks import CACHE, FRAMEWORKS, Framework
from benchmarks.peers.rllib_server import save_module
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.runtime import haproxy
from serve_app.runtime.launch import DEPLOY_YAML, running

CONNECTIONS = 32
START_TIMEOUT = 180.0
AT_LEAST = {
    "constant": 0.8, "handler": 0.45, "fastapi": 2.0, "short": None, "default": 14.0, "haproxy": 2.8,
    "litserve": 3.0, "mlserver": 3.0, "bentoml": 3.0,
}  # fmt: skip
"""Minimum ratio of our rate to that of each peer."""
SLOWER_BY = 0.3
"""Maximum difference in milliseconds of the median latency with one connection to that of the same handler on uvicorn
alone.
"""
FLAT_BODY = json.dumps({"observation": PLANES.flatten().tolist()}).encode()


@dataclass
class ServerUnderTest:
    """One of the compared servers, and its measurements by round."""

    name: str
    start: Callable[[], AbstractContextManager[str]]
    body: bytes
    connections: tuple[int, ...] = (CONNECTIONS,)
    rates: list[dict[int, float]] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)
    failed: int = 0

    def measure(self, seconds: float) -> None:
        """Measure one round with each number of connections, and with one connection for the latency."""
        with self.start() as url:
            rates = {}
            for connections in self.connections:
                self.failed += measure(url, self.body, connections=connections, seconds=2, warm_up=0).failed
                before = _processor_seconds()
                load = measure(url, self.body, connections=connections, seconds=seconds, warm_up=0)
                spent = sum(after - before.get(pid, after) for pid, after in _processor_seconds().items())
                rates[connections] = load.rate
                self.failed += load.failed
            self.costs.append(1e6 * spent / (load.requests - load.failed))
            one = measure(url, self.body, connections=1, seconds=seconds, warm_up=0.5)
        self.rates.append(rates)
        self.failed += one.failed
        self.latencies.append(one.p50)

    def best(self, number: int) -> float:
        """The rate in a round with the best number of connections."""
        return max(self.rates[number].values())

    @property
    def summary(self) -> str:
        rates = ", ".join(
            f"{median(of_round[count] for of_round in self.rates):,.0f}/s at {count}" for count in self.connections
        )
        failed = f", {self.failed} failed" if self.failed else ""
        cost = f"{median(self.costs):.0f} µs of processor time per request"
        return f"{rates} connections, {cost}, p50 {median(self.latencies):.2f} ms at 1{failed}"


def _processor_seconds() -> dict[int, float]:
    """Processor time of each process that this one, or one of its own, has started."""
    seconds = {}
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            times = process.cpu_times()
            seconds[process.pid] = times.user + times.system
    return seconds


def main(
    quick: Quick = False,
    rounds: int = 3,
    seconds: float = 5.0,
    peers: Annotated[bool, typer.Option("--peers", help="compare with LitServe, MLServer and BentoML")] = False,
    cache: Annotated[Path, typer.Option(help="where they are installed")] = CACHE,
) -> Iterator[Target]:
    """Measure the servers in rounds, and compare ours with the others."""
    rounds, seconds = (1, 2.0) if quick else (rounds, seconds)
    with published() as registry:
        scratch = registry.storage.home.parent
        servers = _frameworks(registry.storage, scratch, cache) if peers else _servers(registry.storage, scratch)
        for number in range(rounds):
            for server in servers.values():
                server.measure(seconds)
                print(f"after round {number + 1}: {server.name}: {server.summary}", flush=True)
    ours = servers["ours"]
    assert not ours.failed, "an action was not answered"
    for key, server in servers.items():
        rate = round(median(server.best(number) for number in range(rounds)))
        yield Target(server.name, rate, "/s", note=server.summary)
        if key in AT_LEAST:
            yield _compare(ours, server, AT_LEAST[key])
    if (handler := servers.get("handler")) is not None:
        slower = median(ours_p50 - bare for ours_p50, bare in zip(ours.latencies, handler.latencies, strict=True))
        yield Target("p50 with one connection", round(slower, 2), "ms", at_most=SLOWER_BY, peer="bare uvicorn")


def _compare(ours: ServerUnderTest, peer: ServerUnderTest, least: float | None) -> Target:
    ratio = median(ours.best(number) / (peer.best(number) or nan) for number in range(len(ours.rates)))
    cheaper = median(theirs / cost for cost, theirs in zip(ours.costs, peer.costs, strict=True))
    note = f"processor time per request 1/{cheaper:.2f}"
    return Target("one replica", ratio, "×", at_least=least, peer=peer.name, note=note)


def _frameworks(storage: Storage, scratch: Path, cache: Path) -> dict[str, ServerUnderTest]:
    """Our server, FastAPI, and the frameworks of `benchmarks.peers.frameworks`."""
    with closing(Registry.open(storage)) as registry:
        (graph,) = registry.artifacts.path(LEAGUE, 1).glob("*.onnx")
    for peer in FRAMEWORKS:
        peer.python(cache)
    return _own_and_fastapi(storage) | {
        peer.name: ServerUnderTest(peer.requirements[0], partial(_framework, peer, graph, cache, scratch), peer.body)
        for peer in FRAMEWORKS
    }


def _own_and_fastapi(storage: Storage) -> dict[str, ServerUnderTest]:
    return {
        "ours": ServerUnderTest("ours", lambda: _ours(storage, 1), BODY),
        "fastapi": ServerUnderTest("FastAPI and torch on uvicorn", lambda: _bare("fastapi", storage), BODY),
    }


def _servers(storage: Storage, scratch: Path) -> dict[str, ServerUnderTest]:
    checkpoint = scratch / "rllib"
    save_module(checkpoint)
    return _own_and_fastapi(storage) | {
        "ours, 2": ServerUnderTest("ours, two replicas as in deploy.yaml", lambda: _ours(storage, 2), BODY),
        "constant": ServerUnderTest("a constant on Serve", lambda: _constant(storage, scratch, "build_app"), BODY),
        "short": ServerUnderTest(
            "a constant past Serve's handling", lambda: _constant(storage, scratch, "build_short"), BODY
        ),
        "handler": ServerUnderTest("the same handler on bare uvicorn", lambda: _bare("handler", storage), BODY),
        "haproxy": ServerUnderTest(
            "RLlib's example, one torch thread, our HAProxy settings", lambda: _tuned(checkpoint), FLAT_BODY
        ),
        "default": ServerUnderTest(
            "RLlib's example, one torch thread, default Serve",
            lambda: _rllib_server(checkpoint, {"OMP_NUM_THREADS": "1"}),
            FLAT_BODY,
            (5, CONNECTIONS),
        ),
    }


@contextmanager
def _framework(framework: Framework, graph: Path, cache: Path, scratch: Path) -> Iterator[str]:
    with framework.serving(graph, cache, scratch) as (url, server):
        _await(url, server, framework.body)
        yield url


@contextmanager
def _ours(storage: Storage, replicas: int) -> Iterator[str]:
    with running(storage, replicas=replicas) as url:
        yield url + ACTION


@contextmanager
def _constant(storage: Storage, scratch: Path, factory: str) -> Iterator[str]:
    document = yaml.safe_load(DEPLOY_YAML.read_text())
    (application,) = document["applications"]
    application["import_path"] = f"benchmarks.peers.constant_app:{factory}"
    document.pop("grpc_options")
    deploy = scratch / "constant.yaml"
    deploy.write_text(yaml.safe_dump(document))
    with running(storage, replicas=1, deploy=deploy) as url:
        yield url + ACTION


@contextmanager
def _bare(kind: str, storage: Storage) -> Iterator[str]:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    command = [sys.executable, "-m", "benchmarks.peers.bare_servers", kind, str(storage.home), str(port)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, env=environment) as server:
        url = f"http://127.0.0.1:{port}{ACTION}"
        assert server.stdin is not None
        try:
            _await(url, server)
            yield url
        finally:
            server.stdin.close()


def _await(url: str, server: "subprocess.Popen[bytes]", body: bytes = BODY) -> None:
    deadline = time.monotonic() + START_TIMEOUT
    while time.monotonic() < deadline and server.poll() is None:
        try:
            httpx.post(url, content=body, headers={"content-type": "application/json"}).raise_for_status()
        except httpx.HTTPError:
            time.sleep(0.05)
        else:
            return
    raise RuntimeError(f"{url} does not answer")


@contextmanager
def _tuned(checkpoint: Path) -> Iterator[str]:
    with haproxy.private_directory() as directory, _rllib_server(checkpoint, haproxy.environment(directory)) as url:
        yield url


@contextmanager
def _rllib_server(checkpoint: Path, environment: dict[str, str]) -> Iterator[str]:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    command = [sys.executable, "-m", "benchmarks.peers.rllib_server", str(checkpoint), str(port)]
    with subprocess.Popen(
        command,
        cwd=ROOT,
        env=os.environ | environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as server:
        assert server.stdout is not None
        assert server.stdin is not None
        try:
            if b"up" not in server.stdout.readline():
                raise RuntimeError("RLlib's example did not start")
            yield f"http://127.0.0.1:{port}/rllib-rlmodule"
        finally:
            server.stdin.close()
