"""What does a request with one row cost in each format? Processor time of the server per answered request.

Our handler on uvicorn and our service on grpc.aio, without Ray and HAProxy, and the 2×256 network for connect four.
Formats alternate within a round, ratios are computed within a round, and the medians over the rounds are reported.
Peers of JSON read the same body, check nothing, run the same graph and answer with the action only: a protocol of
asyncio with orjson, the leanest server in Python, and an ASGI application on uvicorn. The peer of the other formats
over HTTP is JSON; that of gRPC is a call of grpc.aio that is answered with an empty message.
"""

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from statistics import median

import grpc
import numpy as np
import psutil

from benchmarks.harness import Quick, Target
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, PLANES, published
from benchmarks.load import http, websocket
from benchmarks.load.elsewhere import run_elsewhere
from benchmarks.peers.bare_servers import INFER, started
from serve_app.inference.stream_codec import encode_request
from serve_app.inference_protocol import open_inference_pb2 as messages

CONNECTIONS = 32
JSON, EMPTY = "JSON", "grpc.aio, empty"
PROTOCOL, ASGI = "JSON, a protocol on uvloop", "JSON, ASGI without a framework"
PEERS = (
    (JSON, PROTOCOL, 2.0, 0.7),
    (JSON, ASGI, None, None),
    ("/v2, binary", JSON, 0.9, 0.9),
    ("stream, binary", JSON, 0.5, 0.5),
    ("gRPC", EMPTY, 1.4, 1.4),
)
"""Format, its peer, and the largest ratios to it with one connection and with many."""
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

Ask = Callable[[int, int, float], float]
"""(port, connections, seconds) → answered requests. Fails if one is not answered."""


def main(quick: Quick = False, rounds: int = 7, seconds: float = 3.0) -> Iterator[Target]:
    """Measure all formats with one connection and with many."""
    rounds, seconds = (1, 1.0) if quick else (rounds, seconds)
    with published() as registry, ExitStack() as stack:
        kinds = {kind for kind, _ in FORMATS.values()}
        servers = {kind: stack.enter_context(started(kind, registry.storage.home)) for kind in kinds}
        for connections in (1, CONNECTIONS):
            costs: dict[str, list[float]] = {name: [] for name in FORMATS}
            for _ in range(rounds):
                for name, (kind, ask) in FORMATS.items():
                    costs[name].append(_cost(*servers[kind], ask, connections, seconds))
            for name, of_rounds in costs.items():
                yield Target(f"{name}, connections: {connections}", round(median(of_rounds), 1), "µs")
            for name, peer, *limits in PEERS:
                ratio = median(one / other for one, other in zip(costs[name], costs[peer], strict=True))
                most = limits[connections > 1]
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


_over_json = _over_http(ACTION, BODY, dict(http.JSON))
FORMATS: dict[str, tuple[str, Ask]] = {
    JSON: ("handler", _over_json),
    PROTOCOL: ("protocol", _over_json),
    ASGI: ("asgi", _over_json),
    "/v2, binary": ("handler", _over_http(f"/v2/models/{LEAGUE}/infer", *http.binary(ARRAYS))),
    "stream, binary": ("handler", _over_stream),
    "gRPC": ("grpc", _over_grpc),
    EMPTY: ("empty_grpc", _over_grpc),
}
"""Format → the kind of server, and how it is asked."""
