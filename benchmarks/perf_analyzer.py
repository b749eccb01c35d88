"""How does Triton's load generator rate the server, and do its counts agree with the server's?

`perf_analyzer` of the tritonclient wheel measures one replica over REST and gRPC with 1 to 16 concurrent requests for
one action of connect four. It reads the server's statistics before and after each window, and finds the version by
itself. The server also counts the requests at the edges of the windows: a small difference of the counts is expected.
Target: all runs succeed, no request fails, and the counts differ by at most 5 %.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.leagues.served_league import LEAGUE, PLANES, publish
from serve_app.runtime import haproxy
from serve_app.runtime.launch import running

CONCURRENCY = (1, 2, 4, 8, 16)
PROTOCOLS = {"http": "REST", "grpc": "gRPC"}
STABLE = 30
"""Variation of three successive windows, in percent, up to which a measurement counts as stable."""
TRIALS = 20
TOLERANCE = 0.05
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

    @property
    def agrees(self) -> bool:
        """Whether the counts of client and server are about equal."""
        return abs(self.server - self.client) <= TOLERANCE * self.client


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
    found = [each.search(done.stdout) for each in (CLIENT, SERVER, RESULT)]
    if done.returncode or None in found:
        raise RuntimeError(f"{' '.join(command)} exited with {done.returncode}:\n{done.stdout}{done.stderr}")
    client, server, result = (each.groups() for each in found if each is not None)
    return Measured(float(result[0]), int(result[1]), int(client[0]), int(server[0]))


def report(tool: str, model: str, addresses: dict[str, str], concurrency: Sequence[int], milliseconds: int) -> bool:
    """Print each run; whether all succeed and all counts agree."""
    print(f"{'protocol':>9} {'concurrency':>12} {'requests/s':>11} {'mean ms':>8} {'client':>8} {'server':>8}")
    fine = True
    for protocol, address in addresses.items():
        for each in concurrency:
            try:
                found = measure(tool, model, protocol, address, each, milliseconds)
            except RuntimeError as error:
                print(f"{PROTOCOLS[protocol]:>9} {each:>12} {error}", flush=True)
                fine = False
                continue
            print(
                f"{PROTOCOLS[protocol]:>9} {each:>12} {found.rate:>11,.0f} {found.latency / 1000:>8.2f}"
                f" {found.client:>8,} {found.server:>8,}",
                flush=True,
            )
            fine &= found.agrees
    return fine


def main() -> int:
    """Print each run; 1 if one fails or its counts disagree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="windows of 1 s instead of 5 s")
    milliseconds = 1000 if parser.parse_args().quick else 5000
    try:
        tool = find()
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch), versions=1)
        port, grpc_port = haproxy.free_ports(2, "127.0.0.1")
        with running(registry.storage, port=port, grpc_port=grpc_port, replicas=1):
            addresses = {"http": f"127.0.0.1:{port}", "grpc": f"127.0.0.1:{grpc_port}"}
            fine = report(tool, LEAGUE, addresses, CONCURRENCY, milliseconds)
    print(f"all runs succeed, and counts of client and server agree: {'met' if fine else 'MISSED'}")
    return int(not fine)


if __name__ == "__main__":
    sys.exit(main())
