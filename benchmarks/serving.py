"""How fast is the action endpoint, compared with other policy servers and with the software it is built on?

All have a 2×256 network for connect four. Ours parses the board, checks board and mask, and answers with the legal
action, the version and its digest. Ratios are computed within a round, and the medians over the rounds are reported.

costs   Processor time of all processes of a server per answered request, which hardly depends on what else runs on the
        machine: `league serve` with two replicas, and FastAPI with ONNX Runtime on uvicorn. All servers run at the same
        time and are loaded in turn, with one connection, with 32, and with so many that each waits for the others.
        `one_row` compares the handler alone with the leanest server in Python.
rates   Answered requests per second of one replica. Peers: FastAPI with torch on uvicorn; a Serve application with the
        same settings that reads the same body and answers with a constant; RLlib's example of serving a policy, which
        reads a flat board and answers with the arg max. By default Serve sends 5 concurrent requests to a replica and
        backs off beyond that: RLlib's example is measured with 5 connections, too, and its better rate counts. Servers
        run one at a time.

--peers compares rates with LitServe, MLServer and BentoML instead, one worker each, next to FastAPI. They run our graph
with ONNX Runtime, answer with the action only, and are installed into a cache folder.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
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

from benchmarks.harness import ROOT, Parts, Quick, Target, chosen
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, PLANES, published
from benchmarks.load.http import Load, measure
from benchmarks.peers.bare_servers import started
from benchmarks.peers.frameworks import CACHE, FRAMEWORKS, Framework
from benchmarks.peers.rllib_server import save_module
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.runtime import haproxy
from serve_app.runtime.launch import DEPLOY_YAML, running

CONNECTIONS = 32
START_TIMEOUT = 180.0
CROWDS = (256, 1024)
"""Connections of which none may be refused."""
NODE, HANDLER, FASTAPI = "league serve", "the handler on uvicorn", "FastAPI and ONNX Runtime on uvicorn"
COSTS = ((NODE, CONNECTIONS), (FASTAPI, CONNECTIONS), *((NODE, crowd) for crowd in CROWDS), (NODE, 1), (HANDLER, 1))
"""Servers and the numbers of connections with which their costs are measured."""
CHEAPER = 0.5
"""Maximum ratio of the processor time per request to that of FastAPI."""
AT_LEAST = {
    "constant": 0.8, "fastapi": 2.0, "short": None, "default": 14.0, "haproxy": 2.8,
    "litserve": 3.0, "mlserver": 3.0, "bentoml": 3.0,
}  # fmt: skip
"""Minimum ratio of our rate to that of each peer."""
SLOWER_BY = 0.3
"""Maximum difference in milliseconds of the median latency with one connection to that of the same handler on uvicorn
alone.
"""
FLAT_BODY = json.dumps({"observation": PLANES.flatten().tolist()}).encode()

Start = Callable[[], AbstractContextManager[str]]
"""Serves while the context is active, and yields the URL that answers."""


@dataclass(frozen=True, slots=True)
class Server:
    """A server that answers. roots: ids of its processes that this one has started."""

    url: str
    roots: list[int]

    def load(self, body: bytes, connections: int, seconds: float, warm_up: float) -> Load:
        """Load the server, and measure the time of all its processes."""
        return measure(self.url, body, connections=connections, seconds=seconds, warm_up=warm_up, server=self.roots)


@contextmanager
def _server(start: Start) -> Iterator[Server]:
    before = set(psutil.Process().children())
    with start() as url:
        yield Server(url, [process.pid for process in psutil.Process().children() if process not in before])


@dataclass
class ServerUnderTest:
    """One of the servers whose rates are compared, and its measurements: in each round, connections → load."""

    name: str
    start: Start
    body: bytes
    connections: tuple[int, ...] = (CONNECTIONS,)
    rounds: list[dict[int, Load]] = field(default_factory=list)

    def measure(self, seconds: float) -> None:
        """Measure one round."""
        with _server(self.start) as server:
            self.rounds.append({number: server.load(self.body, number, seconds, 2.0) for number in self.connections})

    def best(self, number: int) -> Load:
        """The load of a round with the best number of connections."""
        return max(self.rounds[number].values(), key=lambda load: load.rate)

    @property
    def failed(self) -> int:
        """Requests that were not answered, of all rounds."""
        return sum(load.failed for loads in self.rounds for load in loads.values())

    @property
    def summary(self) -> str:
        texts = []
        for number in self.connections:
            loads = [of_round[number] for of_round in self.rounds]
            texts.append(f"at {number} connections {_speed(loads)}, {_median(loads, 'cost'):.0f} µs of processor time")
        return "; ".join(texts) + (f"; {self.failed} failed" if self.failed else "")


def main(
    parts: Parts = None,
    quick: Quick = False,
    peers: Annotated[bool, typer.Option("--peers", help="rates of LitServe, MLServer and BentoML")] = False,
    cache: Annotated[Path, typer.Option(help="where they are installed")] = CACHE,
) -> Iterator[Target]:
    """Measure the servers in rounds, and compare ours with the others."""
    with published() as registry:
        storage = registry.storage
        measurements = {
            "costs": partial(_costs, storage, quick),
            "rates": partial(_rates, storage, quick, peers, cache),
        }
        for measurement in chosen(parts, measurements).values():
            yield from measurement()


def _costs(storage: Storage, quick: bool) -> Iterator[Target]:
    rounds, seconds = (1, 1.0) if quick else (7, 3.0)
    starts: dict[str, Start] = {
        NODE: lambda: _ours(storage, 2),
        HANDLER: lambda: _bare("handler", storage),
        FASTAPI: lambda: _bare("fastapi", storage),
    }
    loads: dict[tuple[str, int], list[Load]] = {key: [] for key in COSTS}
    with ExitStack() as stack:
        servers = {name: stack.enter_context(_server(start)) for name, start in starts.items()}
        for _ in range(rounds):
            for name, connections in COSTS:
                # Without a warm-up, because none may be refused while the connections are opened either.
                load = servers[name].load(BODY, connections, seconds, 0.0)
                loads[name, connections].append(load)
    for (name, connections), of_rounds in loads.items():
        failed, requests = sum(load.failed for load in of_rounds), sum(load.requests for load in of_rounds)
        cost = round(_median(of_rounds, "cost"), 1)
        yield Target(f"{name}, connections: {connections}", cost, "µs", note=_speed(of_rounds))
        if connections in CROWDS:
            yield Target(f"{name}, connections: {connections}, refused", failed, at_most=0, note=f"of {requests:,}")
        elif connections == 1:
            yield Target(f"{name}, p50 with one connection", round(_median(of_rounds, "p50"), 2), "ms")
    pairs = zip(loads[NODE, CONNECTIONS], loads[FASTAPI, CONNECTIONS], strict=True)
    ratio = median(node.cost / peer.cost for node, peer in pairs)
    yield Target(f"{NODE}, processor time per request", ratio, "×", at_most=CHEAPER, peer=FASTAPI)
    slower = median(node.p50 - bare.p50 for node, bare in zip(loads[NODE, 1], loads[HANDLER, 1], strict=True))
    yield Target("p50 with one connection", round(slower, 2), "ms", at_most=SLOWER_BY, peer="bare uvicorn")


def _speed(loads: Sequence[Load]) -> str:
    rate, p50, p99 = (_median(loads, name) for name in ("rate", "p50", "p99"))
    return f"{rate:,.0f}/s, p50 {p50:.2f} ms, p99 {p99:.1f} ms"


def _median(loads: Sequence[Load], name: str) -> float:
    return median(getattr(load, name) for load in loads)


def _rates(storage: Storage, quick: bool, peers: bool, cache: Path) -> Iterator[Target]:
    rounds, seconds = (1, 2.0) if quick else (3, 5.0)
    scratch = storage.home.parent
    servers = _frameworks(storage, scratch, cache) if peers else _servers(storage, scratch)
    for number in range(rounds):
        for server in servers.values():
            server.measure(seconds)
            print(f"after round {number + 1}: {server.name}: {server.summary}", flush=True)
    ours = servers["ours"]
    assert not ours.failed, "an action was not answered"
    for key, server in servers.items():
        rate = round(median(server.best(number).rate for number in range(rounds)))
        yield Target(server.name, rate, "/s", note=server.summary)
        if key in AT_LEAST:
            yield _compare(ours, server, AT_LEAST[key])


def _compare(ours: ServerUnderTest, peer: ServerUnderTest, least: float | None) -> Target:
    ratio = median(ours.best(number).rate / (peer.best(number).rate or nan) for number in range(len(ours.rounds)))
    return Target("one replica", ratio, "×", at_least=least, peer=peer.name)


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
        "fastapi": ServerUnderTest("FastAPI and torch on uvicorn", lambda: _bare("fastapi_torch", storage), BODY),
    }


def _servers(storage: Storage, scratch: Path) -> dict[str, ServerUnderTest]:
    checkpoint = scratch / "rllib"
    save_module(checkpoint)
    return _own_and_fastapi(storage) | {
        "constant": ServerUnderTest("a constant on Serve", lambda: _constant(storage, scratch, "build_app"), BODY),
        "short": ServerUnderTest(
            "a constant past Serve's handling", lambda: _constant(storage, scratch, "build_short"), BODY
        ),
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
    with started(kind, storage.home) as (_, port):
        yield f"http://127.0.0.1:{port}{ACTION}"


def _await(url: str, server: "subprocess.Popen[bytes]", body: bytes) -> None:
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
