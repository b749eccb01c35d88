"""What does a request with one row cost in each format? Processor time of the server per answered request.

Our handler on uvicorn and our service on grpc.aio, without Ray and HAProxy, and the 2×256 network for connect four.
Formats alternate within a round, ratios are computed within a round, and the medians over the rounds are reported. The
peer of the formats over HTTP is JSON; that of gRPC is a call of grpc.aio that is answered with an empty message.
"""

import asyncio
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from statistics import median

import grpc
import numpy as np
import psutil

from benchmarks.harness import ROOT, Quick, Target
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, PLANES, published
from benchmarks.load import http, websocket
from benchmarks.load.elsewhere import run_elsewhere
from benchmarks.peers.bare_servers import INFER
from league.settings import Storage
from serve_app.inference.stream_codec import encode_request
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.runtime import haproxy
from tests.support.waiting import until

CONNECTIONS = 32
JSON, EMPTY = "JSON", "grpc.aio, empty"
PEERS = {"/v2, binary": (JSON, 0.9), "stream, binary": (JSON, 0.5), "gRPC": (EMPTY, 1.4)}
"""Format → its peer, and the largest ratio to it."""
ARRAYS = {"observation": PLANES[None], "action_mask": np.ones((1, 7), np.int8)}
CALL = messages.ModelInferRequest(
    model_name=LEAGUE,
    inputs=[
        messages.ModelInferRequest.InferInputTensor(name=name, datatype="INT8", shape=array.shape)
        for name, array in ARRAYS.items()
    ],
    outputs=[messages.ModelInferRequest.InferRequestedOutputTensor(name="action")],
    raw_input_contents=[array.tobytes() for array in ARRAYS.values()],
).SerializeToString()
START_TIMEOUT = 180.0

Ask = Callable[[int, int, float], float]
"""(port, connections, seconds) → answered requests. Fails if one is not answered."""


def main(quick: Quick = False, rounds: int = 7, seconds: float = 3.0) -> Iterator[Target]:
    """Measure all formats with one connection and with many."""
    rounds, seconds = (1, 1.0) if quick else (rounds, seconds)
    with published() as registry, ExitStack() as stack:
        servers = {
            kind: stack.enter_context(_server(kind, registry.storage)) for kind in ("handler", "grpc", "empty_grpc")
        }
        for connections in (1, CONNECTIONS):
            costs: dict[str, list[float]] = {name: [] for name in FORMATS}
            for _ in range(rounds):
                for name, (kind, ask) in FORMATS.items():
                    costs[name].append(_cost(*servers[kind], ask, connections, seconds))
            for name, of_rounds in costs.items():
                yield Target(f"{name}, connections: {connections}", round(median(of_rounds), 1), "µs")
            for name, (peer, most) in PEERS.items():
                ratio = median(one / other for one, other in zip(costs[name], costs[peer], strict=True))
                yield Target(f"{name}, connections: {connections}", ratio, "×", at_most=most, peer=peer)


def _cost(server: psutil.Process, port: int, ask: Ask, connections: int, seconds: float) -> float:
    """Processor time per answered request, in microseconds."""
    ask(port, connections, 0.3)
    before = server.cpu_times()
    answered = ask(port, connections, seconds)
    after = server.cpu_times()
    return 1e6 * (after.user + after.system - before.user - before.system) / answered


def _over_http(path: str, body: bytes, headers: dict[str, str]) -> Ask:
    def ask(port: int, connections: int, seconds: float) -> float:
        url = f"http://127.0.0.1:{port}{path}"
        result = http.measure(url, body, connections=connections, seconds=seconds, warm_up=0, headers=headers)
        assert not result.failed, result.statuses
        return result.requests

    return ask


def _over_stream(port: int, connections: int, seconds: float) -> float:
    url, message = f"http://127.0.0.1:{port}/v1/policies/{LEAGUE}/stream", encode_request(ARRAYS.values(), 1)
    result = websocket.measure(url, message, is_text=False, streams=connections, seconds=seconds, warm_up=0)
    assert not result.failures
    return result.messages


def _over_grpc(port: int, connections: int, seconds: float) -> float:
    return run_elsewhere(_calls, port, connections, seconds)


async def _calls(port: int, connections: int, seconds: float) -> int:
    answered = 0
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        infer = channel.unary_unary(INFER)
        stop = time.perf_counter() + seconds

        async def repeat() -> None:
            nonlocal answered
            while time.perf_counter() < stop:
                await infer(CALL)
                answered += 1

        await asyncio.gather(*(repeat() for _ in range(connections)))
    return answered


FORMATS: dict[str, tuple[str, Ask]] = {
    JSON: ("handler", _over_http(ACTION, BODY, dict(http.JSON))),
    "/v2, binary": ("handler", _over_http(f"/v2/models/{LEAGUE}/infer", *http.binary(ARRAYS))),
    "stream, binary": ("handler", _over_stream),
    "gRPC": ("grpc", _over_grpc),
    EMPTY: ("empty_grpc", _over_grpc),
}
"""Format → the kind of server, and how it is asked."""


@contextmanager
def _server(kind: str, storage: Storage) -> Iterator[tuple[psutil.Process, int]]:
    """The process and the port of one of `bare_servers`."""
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    command = [sys.executable, "-m", "benchmarks.peers.bare_servers", kind, str(storage.home), str(port)]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, env=os.environ | {"OMP_NUM_THREADS": "1"}
    ) as server:
        assert server.stdin is not None
        try:
            until(lambda: not haproxy.is_free("127.0.0.1", port), START_TIMEOUT)
            yield psutil.Process(server.pid), port
        finally:
            server.stdin.close()
