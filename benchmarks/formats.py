"""Which request format is the fastest: HTTP or a stream, JSON or binary, single or batched, REST or gRPC?

One replica behind HAProxy, the 2×256 network for connect four, and pistonball's convolutional network. HTTP with 32
connections is compared with a stream with 16, each with one request in flight; a batch of 256 in binary; the same
request over REST and gRPC, with the unmodified tritonclient; one image as JSON, PNG and binary, beside the time of
inference alone in this process. Compared measurements alternate within a round, and the medians over the rounds are
reported.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
import orjson
import tritonclient.grpc as over_grpc
import tritonclient.http as over_http
from numpy.typing import NDArray

from benchmarks.leagues.served_league import BODY, LEAGUE, PLANES, publish
from benchmarks.load import http as load
from benchmarks.load import websocket as stream_load
from benchmarks.parity import CONFIGS, prepare, situations
from benchmarks.training.learned import local_ray
from league.client.requests import encode
from league.policies import load as load_policy
from league.registry.registry import Registry
from league.registry.storage.manifest import TRAINING
from league.registry.storage.rows import VersionRow
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
BINARY = {"Content-Type": "application/octet-stream"}
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
DATATYPES = {"int8": "INT8", "uint8": "UINT8"}


def main() -> int:
    """Print the measurements; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--quick", action="store_true", help="smoke test: one short round")
    options = parser.parse_args()
    rounds, seconds = (1, 1.0) if options.quick else (options.rounds, options.seconds)
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch) / "home", versions=1)
        with local_ray(1):
            small = prepare(CONFIGS / "pistonball_gpu.yaml", registry, updates=0)
            large = prepare(CONFIGS / "pistonball_gpu.yaml", registry, updates=0, source="parity/2", **MNIH)
        image = _image(registry, large)
        (grpc_port,) = haproxy.free_ports(1, "127.0.0.1")
        with running(registry.storage, replicas=1, grpc_port=grpc_port) as url:
            met = [
                _streams(url, rounds, seconds),
                _batches(url, rounds, seconds),
                _protocols(url.removeprefix("http://"), f"127.0.0.1:{grpc_port}", rounds, seconds),
                _images(url, registry, small, image, rounds, seconds, has_target=False),
                _images(url, registry, large, image, rounds, seconds, has_target=True),
            ]
        registry.close()
    return int(not all(met))


def _streams(url: str, rounds: int, seconds: float) -> bool:
    policy = f"{url}/v1/policies/{LEAGUE}"
    message = encode_request([PLANES[None], np.ones((1, 7), np.int8)], 1)
    measurements: dict[str, Callable[[int], load.Load | stream_load.StreamLoad]] = {
        "HTTP, JSON": lambda n: load.measure(f"{policy}/action", BODY, connections=n, seconds=seconds),
        "stream, JSON": lambda n: stream_load.measure(
            f"{policy}/stream", BODY, is_text=True, streams=n, seconds=seconds
        ),
        STREAM: lambda n: stream_load.measure(f"{policy}/stream", message, is_text=False, streams=n, seconds=seconds),
    }
    rates: dict[str, list[float]] = {name: [] for name in measurements}
    latencies: dict[str, list[float]] = {name: [] for name in measurements}
    for _ in range(rounds):
        for name, ask in measurements.items():
            rates[name].append(ask(CONNECTIONS if name.startswith("HTTP") else STREAMS).rate)
            latencies[name].append(ask(1).p50)
    for name in measurements:
        print(f"{name}: {median(rates[name]):,.0f}/s, p50 with one connection {median(latencies[name]):.3f} ms")
    http, best = "HTTP, JSON", STREAM
    faster = median(own / other for own, other in zip(rates[best], rates[http], strict=True))
    sooner = median(own / other for own, other in zip(latencies[best], latencies[http], strict=True))
    print(f"{best} over {http}, rate: {faster:.2f}×   (at least {FASTER:g}×)")
    print(f"{best} over {http}, p50: {sooner:.2f}×   (at most {SOONER:g}×)", flush=True)
    return faster >= FASTER and sooner <= SOONER


def _batches(url: str, rounds: int, seconds: float) -> bool:
    boards = np.repeat(PLANES[None], BATCH, axis=0)
    body, headers = binary({"observation": boards, "action_mask": np.ones((BATCH, 7), np.int8)})
    infer = f"{url}/v2/models/{LEAGUE}/infer"
    message = encode_request([boards, np.ones((BATCH, 7), np.int8)], BATCH)
    rest, stream = [], []
    for _ in range(rounds):
        rest.append(load.measure(infer, body, connections=4, seconds=seconds, headers=headers).rate * BATCH)
        streamed = stream_load.measure(
            f"{url}/v1/policies/{LEAGUE}/stream", message, is_text=False, streams=4, seconds=seconds
        )
        stream.append(streamed.rate * BATCH)
    print(f"batches of {BATCH}, REST binary: {median(rest):,.0f} actions/s   (at least {ACTIONS:,})")
    print(f"batches of {BATCH}, stream, binary: {median(stream):,.0f} actions/s", flush=True)
    return median(rest) >= ACTIONS


def _protocols(rest: str, grpc: str, rounds: int, seconds: float) -> bool:
    for rows in (1, BATCH):
        texts = []
        for module, address in ((over_http, rest), (over_grpc, grpc)):
            with module.InferenceServerClient(address) as client:
                inputs = _inputs(module, rows)
                times = [_p50(lambda c=client, i=inputs: c.infer(LEAGUE, i), seconds) for _ in range(rounds)]
            texts.append(median(times))
        print(f"tritonclient, {rows} rows: REST binary {texts[0]:.2f} ms, gRPC {texts[1]:.2f} ms", end="")
        print(f", gRPC over REST: {texts[1] / texts[0]:.2f}×", flush=True)
    return True


def _inputs(module: object, rows: int) -> list[object]:
    arrays = {"observation": np.repeat(PLANES[None], rows, axis=0), "action_mask": np.ones((rows, 7), np.int8)}
    inputs = []
    for name, array in arrays.items():
        given = module.InferInput(name, list(array.shape), "INT8")  # type: ignore[attr-defined]
        given.set_data_from_numpy(array)
        inputs.append(given)
    return inputs


def _p50(call: Callable[[], object], seconds: float) -> float:
    """Median duration of a call, in milliseconds."""
    for _ in range(20):
        call()
    times, stop = [], time.perf_counter() + seconds
    while (now := time.perf_counter()) < stop:
        call()
        times.append(time.perf_counter() - now)
    return median(times) * 1e3


@dataclass(frozen=True, slots=True)
class _Form:
    path: str
    body: bytes
    headers: Mapping[str, str]


def _images(
    url: str, registry: Registry, version: VersionRow, image: NDArray, rounds: int, seconds: float, has_target: bool
) -> bool:
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
            seen = load.measure(url + form.path, form.body, connections=1, seconds=seconds, headers=form.headers)
            assert not seen.failed, f"{name}: {seen.statuses}"
            times[name].append(seen.p50)
        answered = stream_load.measure(streamed, message, is_text=False, streams=1, seconds=seconds)
        assert not answered.failures
        times[STREAM].append(answered.p50)
    alone = median(inference)
    sizes = {name: len(form.body) for name, form in forms.items()} | {STREAM: len(message)}
    print(f"a picture of {image.shape}, network of {_megabytes(registry, version):.1f} MB, ", end="")
    print(f"inference alone: {alone:.2f} ms")
    for name, taken in times.items():
        share = alone / median(taken)
        print(f"{name}: {sizes[name]:,} bytes, p50 {median(taken):.2f} ms, inference {share:.0%} of it")
    met = True
    for name in ("binary", STREAM):
        beside = median(own / other for own, other in zip(times[name], inference, strict=True))
        limit = f"   (at most {BESIDE_INFERENCE:g}×)" if has_target and name == "binary" else ""
        print(f"{name} over inference alone: {beside:.2f}×{limit}", flush=True)
        met = met and not (limit and beside > BESIDE_INFERENCE)
    return met


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


def binary(arrays: Mapping[str, NDArray], outputs: Sequence[str] = ("action",)) -> tuple[bytes, dict[str, str]]:
    """A request with the binary tensor extension: its body and its headers."""
    inputs = [
        {
            "name": name,
            "shape": list(array.shape),
            "datatype": DATATYPES[array.dtype.name],
            "parameters": {"binary_data_size": array.nbytes},
        }
        for name, array in arrays.items()
    ]
    has_target = [{"name": name, "parameters": {"binary_data": True}} for name in outputs]
    head = orjson.dumps({"inputs": inputs, "outputs": has_target})
    body = head + b"".join(array.tobytes() for array in arrays.values())
    return body, BINARY | {"Inference-Header-Content-Length": str(len(head))}


def _document(observation: object) -> bytes:
    return orjson.dumps({"observation": observation})


if __name__ == "__main__":
    sys.exit(main())
