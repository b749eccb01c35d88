"""Which request format is the fastest: HTTP or a stream, JSON or binary, single or batched, REST or gRPC?

One replica behind HAProxy, the 2×256 network for connect four, and pistonball's convolutional network. HTTP with 32
connections is compared with a stream with 16, each with one request in flight; a batch of 256 in binary; the same
request over REST and gRPC, with the unmodified tritonclient; one image as JSON, PNG and binary, beside the time of
inference alone in this process. Compared measurements alternate within a round, and the medians over the rounds are
reported.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from statistics import median

import numpy as np
import orjson
import tritonclient.grpc as over_grpc
import tritonclient.http as over_http
from numpy.typing import NDArray

from benchmarks.harness import CONFIGS, Quick, Target
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, PLANES, published
from benchmarks.load import http as load
from benchmarks.load import websocket as stream_load
from benchmarks.load.http import binary
from benchmarks.parity import prepare, situations
from benchmarks.training.learned import local_ray
from league.policies import load as load_policy
from league.registry.registry import Registry
from league.registry.storage.manifest import TRAINING
from league.registry.storage.rows import VersionRow
from policy_league_client.requests import encode
from serve_app.inference.stream_codec import encode_request
from serve_app.runtime import haproxy
from serve_app.runtime.launch import running
from training.export.publish import load_modules

CONNECTIONS, STREAMS = 32, 16
BATCH = 256
FASTER, SOONER = 2.5, 0.6
"""Ratios of the stream's rate and latency to HTTP's."""
ACTIONS = 150_000
"""Actions per second, in batches of 256."""
BESIDE_INFERENCE = 1.3
"""Ratio to the time of inference alone, for an image in binary."""
STREAM = "stream, binary"
MNIH: dict[str, object] = {
    "convolutions": (
        {"filters": 32, "kernel": 8, "stride": 4},
        {"filters": 64, "kernel": 4, "stride": 2},
        {"filters": 64, "kernel": 3, "stride": 1},
    ),
    "hidden": (512,),
}
"""V. Mnih et al., "Human-level control through deep reinforcement learning", Nature 518 (2015)."""


def main(quick: Quick = False, rounds: int = 5, seconds: float = 4.0) -> Iterator[Target]:
    """Measure all formats."""
    rounds, seconds = (1, 1.0) if quick else (rounds, seconds)
    with published() as registry:
        with local_ray(1):
            small = prepare(CONFIGS / "pistonball_gpu.yaml", registry, updates=0)
            large = prepare(CONFIGS / "pistonball_gpu.yaml", registry, updates=0, source="parity/2", **MNIH)
        image = _image(registry, large)
        (grpc_port,) = haproxy.free_ports(1, "127.0.0.1")
        with running(registry.storage, replicas=1, grpc_port=grpc_port) as url:
            yield from _streams(url, rounds, seconds)
            yield from _batches(url, rounds, seconds)
            yield from _protocols(url.removeprefix("http://"), f"127.0.0.1:{grpc_port}", rounds, seconds)
            yield from _images(url, registry, small, image, rounds, seconds, has_target=False)
            yield from _images(url, registry, large, image, rounds, seconds, has_target=True)


def _stream(url: str, message: bytes, streams: int, seconds: float, is_text: bool = False) -> stream_load.StreamLoad:
    address = f"{url}/v1/policies/{LEAGUE}/stream"
    return stream_load.measure(address, message, is_text=is_text, streams=streams, seconds=seconds)


def _streams(url: str, rounds: int, seconds: float) -> Iterator[Target]:
    message = encode_request([PLANES[None], np.ones((1, 7), np.int8)], 1)
    http = "HTTP, JSON"
    measurements: dict[str, Callable[[int], load.Load | stream_load.StreamLoad]] = {
        http: lambda n: load.measure(url + ACTION, BODY, connections=n, seconds=seconds),
        "stream, JSON": lambda n: _stream(url, BODY, n, seconds, is_text=True),
        STREAM: lambda n: _stream(url, message, n, seconds),
    }
    rates: dict[str, list[float]] = {name: [] for name in measurements}
    latencies: dict[str, list[float]] = {name: [] for name in measurements}
    for _ in range(rounds):
        for name, ask in measurements.items():
            rates[name].append(ask(CONNECTIONS if name == http else STREAMS).rate)
            latencies[name].append(ask(1).p50)
    for name in measurements:
        note = f"p50 with one connection {median(latencies[name]):.3f} ms"
        yield Target(name, round(median(rates[name])), "actions/s", note=note)
    faster, sooner = (
        median(stream / other for stream, other in zip(values[STREAM], values[http], strict=True))
        for values in (rates, latencies)
    )
    yield Target(f"{STREAM}, rate", faster, "×", at_least=FASTER, peer=http)
    yield Target(f"{STREAM}, p50", sooner, "×", at_most=SOONER, peer=http)


def _batches(url: str, rounds: int, seconds: float) -> Iterator[Target]:
    boards = np.repeat(PLANES[None], BATCH, axis=0)
    body, headers = binary({"observation": boards, "action_mask": np.ones((BATCH, 7), np.int8)})
    infer = f"{url}/v2/models/{LEAGUE}/infer"
    message = encode_request([boards, np.ones((BATCH, 7), np.int8)], BATCH)
    over_rest, stream = [], []
    for _ in range(rounds):
        over_rest.append(load.measure(infer, body, connections=4, seconds=seconds, headers=headers).rate * BATCH)
        stream.append(_stream(url, message, 4, seconds).rate * BATCH)
    yield Target(f"batches of {BATCH}, REST binary", round(median(over_rest)), "actions/s", at_least=ACTIONS)
    yield Target(f"batches of {BATCH}, {STREAM}", round(median(stream)), "actions/s")


def _protocols(rest: str, grpc: str, rounds: int, seconds: float) -> Iterator[Target]:
    for rows in (1, BATCH):
        medians = []
        for module, address in ((over_http, rest), (over_grpc, grpc)):
            with module.InferenceServerClient(address) as client:
                inputs = _inputs(module, rows)
                times = [_p50(lambda c=client, i=inputs: c.infer(LEAGUE, i), seconds) for _ in range(rounds)]
            medians.append(median(times))
        note = f"{medians[1]:.2f} to {medians[0]:.2f} ms"
        yield Target(f"gRPC by tritonclient, rows: {rows}", medians[1] / medians[0], "×", peer="REST binary", note=note)


def _inputs(module: object, rows: int) -> list[object]:
    arrays = {"observation": np.repeat(PLANES[None], rows, axis=0), "action_mask": np.ones((rows, 7), np.int8)}
    inputs = []
    for name, array in arrays.items():
        tensor = module.InferInput(name, list(array.shape), "INT8")  # type: ignore[attr-defined]
        tensor.set_data_from_numpy(array)
        inputs.append(tensor)
    return inputs


def _p50(call: Callable[[], object], seconds: float) -> float:
    """Median duration of a call, in milliseconds."""
    for _ in range(20):
        call()
    times, stop = [], time.perf_counter() + seconds
    while (moment := time.perf_counter()) < stop:
        call()
        times.append(time.perf_counter() - moment)
    return median(times) * 1e3


@dataclass(frozen=True, slots=True)
class _Form:
    path: str
    body: bytes
    headers: Mapping[str, str]


def _images(
    url: str, registry: Registry, version: VersionRow, image: NDArray, rounds: int, seconds: float, has_target: bool
) -> Iterator[Target]:
    """One image in each format, with one connection. has_target: whether the target applies to this network."""
    policy = load_policy(version.ref, None, registry)
    body, headers = binary({"observation": image[None]})
    action = f"/v1/policies/{version.league}/action?version={version.number}"
    forms = {
        "JSON": _Form(action, _document(image.tolist()), load.JSON),
        "PNG": _Form(action, _document(encode(image, "png")), load.JSON),
        "base64": _Form(action, _document(encode(image, "base64")), load.JSON),
        "binary": _Form(f"/v2/models/{version.league}/versions/{version.number}/infer", body, headers),
    }
    streamed = f"{url}/v1/policies/{version.league}/stream?version={version.number}"
    message = encode_request([image[None]], 1)
    times: dict[str, list[float]] = {name: [] for name in (*forms, STREAM)}
    inference: list[float] = []
    for _ in range(rounds):
        inference.append(_p50(lambda: policy.act({"observation": image[None]}), seconds))
        for name, form in forms.items():
            result = load.measure(url + form.path, form.body, connections=1, seconds=seconds, headers=form.headers)
            assert not result.failed, f"{name}: {result.statuses}"
            times[name].append(result.p50)
        answered = stream_load.measure(streamed, message, is_text=False, streams=1, seconds=seconds)
        assert not answered.failures
        times[STREAM].append(answered.p50)
    alone = median(inference)
    sizes = {name: len(form.body) for name, form in forms.items()} | {STREAM: len(message)}
    network = f"image, network of {_megabytes(registry, version):.1f} MB"
    for name, p50 in times.items():
        note = f"{sizes[name]:,} bytes; inference alone {alone:.2f} ms"
        yield Target(f"{network}, {name}", round(median(p50), 2), "ms", note=note)
    for name in ("binary", STREAM):
        ratio = median(served / bare for served, bare in zip(times[name], inference, strict=True))
        most = BESIDE_INFERENCE if has_target and name == "binary" else None
        yield Target(f"{network}, {name}", ratio, "×", at_most=most, peer="inference alone")


def _megabytes(registry: Registry, version: VersionRow) -> float:
    directory = registry.artifacts.path(version.league, version.number)
    return sum(path.stat().st_size for path in directory.glob("*.onnx")) / 1e6


def _image(registry: Registry, version: VersionRow) -> NDArray:
    """The observation of a piston during play: (84, 84, 4) uint8."""
    row = registry.leagues.get(version.league)
    modules = load_modules(
        registry.artifacts.path(version.league, version.number) / TRAINING, row.config, row.interface
    )
    (batches,) = situations(row.config, row.interface, modules, 64).values()
    return np.ascontiguousarray(batches[-1].observations["observation"][-1])


def _document(observation: object) -> bytes:
    return orjson.dumps({"observation": observation})
