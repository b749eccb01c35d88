"""How fast does the action endpoint answer, against RLlib's own example of serving a policy?

All have a 2×256 network for connect four. Ours reads the board, checks board and mask, and answers with the legal
action, the version and its digest; RLlib's reads a flat board and answers with the arg max. Servers run one at a time,
in rounds, and the medians of the rounds are compared. One replica each, unless it says otherwise.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from statistics import median

from benchmarks.load import measure
from benchmarks.rllib_server import save_module
from benchmarks.served_league import BODY, LEAGUE, PLANES, publish
from league.settings import Storage
from serve_app import haproxy
from serve_app.launch import running

ROOT = Path(__file__).parent.parent
CONNECTIONS = 32
TARGETS = {"default": 12.0, "haproxy": 2.5}
FLAT_BODY = json.dumps({"observation": PLANES.flatten().tolist()}).encode()


@dataclass
class Server:
    """One of those that are compared, and what was measured of it."""

    name: str
    start: Callable[[], AbstractContextManager[str]]
    body: bytes
    rates: list[float] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)

    def measure(self, seconds: float) -> None:
        """One round. Fails if anything but an action was answered."""
        with self.start() as url:
            many = measure(url, self.body, connections=CONNECTIONS, seconds=seconds, warm_up=2)
            one = measure(url, self.body, connections=1, seconds=seconds, warm_up=0.5)
        assert not many.failed, f"{self.name}: {many.statuses}"
        assert not one.failed, f"{self.name}: {one.statuses}"
        self.rates.append(many.rate)
        self.latencies.append(one.p50)

    @property
    def rate(self) -> float:
        return median(self.rates)


def main() -> int:
    """Print each server and the ratios; 1 if one is below its target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--quick", action="store_true", help="one short round: shows that it works, no more")
    options = parser.parse_args()
    rounds, seconds = (1, 2.0) if options.quick else (options.rounds, options.seconds)
    with tempfile.TemporaryDirectory() as scratch:
        servers = _servers(Path(scratch))
        for number in range(rounds):
            for server in servers.values():
                server.measure(seconds)
                print(f"round {number + 1}: {server.name}: {server.rates[-1]:,.0f}/s", flush=True)
    print(f"\n{'':58} {CONNECTIONS} connections   1 connection, p50")
    for server in servers.values():
        print(f"{server.name:58} {server.rate:11,.0f}/s {median(server.latencies):15.2f} ms")
    reached = [_compare(servers, peer, target) for peer, target in TARGETS.items()]
    return int(not all(reached))


def _compare(servers: dict[str, Server], peer: str, target: float) -> bool:
    ratio = servers["ours"].rate / (servers[peer].rate or nan)
    print(f"ours / {servers[peer].name}: {ratio:.1f}×   (at least {target:g}×)")
    return not ratio < target


def _servers(scratch: Path) -> dict[str, Server]:
    storage = publish(scratch / "home", versions=1).storage
    checkpoint = scratch / "rllib"
    save_module(checkpoint)
    return {
        "ours": Server("ours", lambda: _ours(storage, 1), BODY),
        "ours, 2": Server("ours, two replicas as in deploy.yaml", lambda: _ours(storage, 2), BODY),
        "haproxy": Server(
            "RLlib's example, one torch thread, our HAProxy settings", lambda: _tuned(checkpoint), FLAT_BODY
        ),
        "default": Server(
            "RLlib's example, one torch thread, default Serve",
            lambda: _theirs(checkpoint, {"OMP_NUM_THREADS": "1"}),
            FLAT_BODY,
        ),
        "threads": Server(
            "RLlib's example, default threads, default Serve",
            lambda: _theirs(checkpoint, {"OMP_NUM_THREADS": str(os.cpu_count())}),
            FLAT_BODY,
        ),
    }


@contextmanager
def _ours(storage: Storage, replicas: int) -> Iterator[str]:
    with running(storage, replicas=replicas) as url:
        yield f"{url}/v1/policies/{LEAGUE}/action"


@contextmanager
def _tuned(checkpoint: Path) -> Iterator[str]:
    with (
        haproxy.private_directory() as directory,
        _theirs(checkpoint, haproxy.environment(directory)) as url,
    ):
        yield url


@contextmanager
def _theirs(checkpoint: Path, environment: dict[str, str]) -> Iterator[str]:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    command = [sys.executable, "-m", "benchmarks.rllib_server", str(checkpoint), str(port)]
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


if __name__ == "__main__":
    sys.exit(main())
