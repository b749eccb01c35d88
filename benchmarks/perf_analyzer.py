"""How does Triton's load generator rate the server, and do its counts agree with the server's?

`perf_analyzer` of the tritonclient wheel measures one replica over REST and gRPC with 1 to 16 concurrent requests for
one action of connect four. It reads the server's statistics before and after each window, and finds the version by
itself. The server also counts the requests at the edges of the windows: a small difference of the counts is expected.
Target: all runs succeed, no request fails, and the counts differ by at most 5 %.
"""

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness import Quick, Target
from benchmarks.leagues.served_league import LEAGUE, PLANES, served
from serve_app.runtime import haproxy

CONCURRENCY = (1, 2, 4, 8, 16)
PROTOCOLS = {"http": "REST", "grpc": "gRPC"}
STABLE = 30
"""Variation of three successive windows, in percent, up to which a measurement counts as stable."""
TRIALS = 20
TOLERANCE = 5.0
NEEDS = "it needs libb64.so.0d (libb64-0d) and libcudart.so.12 (nvidia-cuda-runtime-cu12) on LD_LIBRARY_PATH"
CLIENT, SERVER, RESULT = (
    re.compile(pattern)
    for pattern in (
        r"\n +Request count: (\d+)",
        r"Successful request count: (\d+)",
        r"Concurrency: \d+, throughput: ([\d.]+) infer/sec, latency (\d+) usec",
    )
)
DATA = {
    "data": [
        {
            "observation": {"content": PLANES.ravel().tolist(), "shape": list(PLANES.shape)},
            "action_mask": {"content": [1] * 7, "shape": [7]},
        }
    ]
}


@dataclass(frozen=True, slots=True)
class Measured:
    """Results of one run. latency: mean, in microseconds. client, server: requests in the windows."""

    rate: float
    latency: int
    client: int
    server: int


def find() -> str:
    """The path of perf_analyzer. Raises RuntimeError if it does not start."""
    beside = Path(sys.executable).with_name("perf_analyzer")
    path = str(beside) if beside.exists() else shutil.which("perf_analyzer")
    if path is None:
        raise RuntimeError("perf_analyzer is not installed: pip install tritonclient")
    done = subprocess.run([path, "--version"], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"perf_analyzer does not start: {NEEDS}: {done.stderr.strip()}")
    return path


def measure(tool: str, model: str, protocol: str, address: str, concurrency: int, milliseconds: int) -> Measured:
    """Run perf_analyzer. Raises RuntimeError if it fails, for example if a request fails."""
    with tempfile.NamedTemporaryFile("w", suffix=".json") as data:
        json.dump(DATA, data)
        data.flush()
        command = [
            tool, "-m", model, "-i", protocol, "-u", address, "--concurrency-range", str(concurrency),
            "--measurement-interval", str(milliseconds), "--stability-percentage", str(STABLE),
            "--max-trials", str(TRIALS), "--input-data", data.name,
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
    matches = [pattern.search(done.stdout) for pattern in (CLIENT, SERVER, RESULT)]
    if done.returncode or None in matches:
        raise RuntimeError(f"{' '.join(command)} exited with {done.returncode}:\n{done.stdout}{done.stderr}")
    client, server, result = (match.groups() for match in matches if match is not None)
    return Measured(float(result[0]), int(result[1]), int(client[0]), int(server[0]))


def main(quick: Quick = False) -> Iterator[Target]:
    """Measure both protocols."""
    tool = find()
    port, grpc_port = haproxy.free_ports(2, "127.0.0.1")
    addresses = {"http": f"127.0.0.1:{port}", "grpc": f"127.0.0.1:{grpc_port}"}
    with served(port=port, grpc_port=grpc_port, replicas=1):
        for protocol, address in addresses.items():
            for concurrency in CONCURRENCY:
                result = measure(tool, LEAGUE, protocol, address, concurrency, 1000 if quick else 5000)
                difference = 100 * abs(result.server - result.client) / result.client
                note = f"{result.rate:,.0f} requests/s, mean {result.latency / 1000:.2f} ms; counted {result.client:,}"
                name = f"{PROTOCOLS[protocol]}, concurrency {concurrency}: difference of the counts"
                yield Target(name, round(difference, 1), "%", at_most=TOLERANCE, note=note)
