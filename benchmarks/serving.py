"""How fast does the action endpoint answer, against RLlib's own example of serving a policy?

All have a 2×256 network for connect four. Ours reads the board, checks board and mask, and answers with the legal
action, the version and its digest; RLlib's reads a flat board and answers with the arg max. Servers run one at a time,
in rounds, and the medians of the rounds are compared. One replica each, unless it says otherwise. By default Serve
gives a replica 5 requests at once and backs off beyond: RLlib's example is measured with 5 connections too, and its
better rate counts.
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
    connections: tuple[int, ...] = (CONNECTIONS,)
    rates: dict[int, list[float]] = field(default_factory=dict)
    latencies: list[float] = field(default_factory=list)
    failed: int = 0

    def measure(self, seconds: float) -> None:
        """One round at each number of connections, and with one for the latency."""
        with self.start() as url:
            for connections in self.connections:
                load = measure(url, self.body, connections=connections, seconds=seconds, warm_up=2)
                self.rates.setdefault(connections, []).append(load.rate)
                self.failed += load.failed
            one = measure(url, self.body, connections=1, seconds=seconds, warm_up=0.5)
        self.failed += one.failed
        self.latencies.append(one.p50)

    @property
    def rate(self) -> float:
        """The median of the rounds, at the number of connections that suits it best."""
        return max(median(rates) for rates in self.rates.values())

    @property
    def told(self) -> str:
        rates = ", ".join(f"{median(rates):,.0f}/s at {count}" for count, rates in self.rates.items())
        failed = f", {self.failed} failed" if self.failed else ""
        return f"{rates} connections, p50 {median(self.latencies):.2f} ms at 1{failed}"


def main() -> int:
    """Print each server and the ratios; 1 if one is below its target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--quick", action="store_true", help="one short round: shows that it works, no more")
    options = parser.parse_args()
    rounds, seconds = (1, 2.0) if options.quick else (options.rounds, options.seconds)
    with tempfile.TemporaryDirectory() as scratch:
        servers = _servers(Path(scratch))
        for number in range(rounds):
            for server in servers.values():
                server.measure(seconds)
                print(f"after round {number + 1}: {server.name}: {server.told}", flush=True)
    print()
    for server in servers.values():
        print(f"{server.name}: {server.told}")
    assert not servers["ours"].failed, "an action was not answered"
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
            (5, CONNECTIONS),
        ),
        "threads": Server(
            "RLlib's example, default threads, default Serve",
            lambda: _theirs(checkpoint, {"OMP_NUM_THREADS": str(os.cpu_count())}),
            FLAT_BODY,
            (5, CONNECTIONS),
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
