"""What can one caller do to the others?

Memory that a caller without a key can hold in a replica, and how long a caller can stall a probe.

grpc_messages     messages of gRPC with millions of elements
websocket_pings   streams that send pings, pongs and fragments; without a key, to a server that requires none
idle_connections  thousands of connections that are idle, or of which nothing arrives

Each attack is a module of benchmarks.attacks, which runs in a process of its own:

    python -m benchmarks.attacks.ATTACK URL GRPC_ADDRESS TOKEN

It prints a line when it has started, and attacks until it is killed. TOKEN is empty, or a key that allows one request
per second. A stall is the longest wait of a probe during the attack minus that in a control run before it.
"""

import math
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import psutil

from benchmarks.harness import Parts, Quick, Target, chosen
from benchmarks.leagues.served_league import ACTION, BODY, published
from benchmarks.load.http import JSON
from benchmarks.load.probe import measure
from benchmarks.processes import replica_processes
from serve_app.runtime.haproxy import free_ports
from serve_app.runtime.launch import running

ATTACKS = ("grpc_messages", "websocket_pings", "idle_connections")
NEED_ACCESS = ("websocket_pings",)
"""Attacks by callers whose handshake must be accepted."""
REPLICAS = 2
RATE = 1.0
"""Requests per second that the attacker's key allows."""
GROWTH = 50.0
"""Maximum growth of a replica by a caller without a key, in MB."""
STALL = {"keyless": 0.1, "keyed": 0.2}
"""Maximum stall, in seconds."""
SAMPLE = 0.05
"""Seconds between two samples of the memory."""


class Growth:
    """Samples the memory of the replicas in a thread.

    largest: by how many bytes a replica grew at most. lost: whether a replica ended.
    """

    def __init__(self, home: Path) -> None:
        """home: LEAGUE_HOME of the server."""
        self._before = {replica: replica.memory_info().rss for replica in replica_processes(home)}
        self._is_over = threading.Event()
        self.largest = 0
        self.lost = False

    @contextmanager
    def sampled(self) -> Iterator[None]:
        """Sample while the context is active."""
        thread = threading.Thread(target=self._sample)
        thread.start()
        try:
            yield
        finally:
            self._is_over.set()
            thread.join()

    def _sample(self) -> None:
        while not self._is_over.wait(SAMPLE):
            for replica, before in self._before.items():
                try:
                    self.largest = max(self.largest, replica.memory_info().rss - before)
                except psutil.NoSuchProcess:
                    self.lost = True


def attacked(
    name: str, url: str, grpc_address: str, token: str, key: str, home: Path, seconds: float, pairs: int
) -> Iterator[Target]:
    """The stall and the growth by one attack with a token. key: an API key for the probe. home: of the server."""
    who = "keyed" if token else "keyless"
    headers = {**JSON, "x-api-key": key}
    measure(url + ACTION, BODY, 1.0, headers)  # warm-up
    growth = Growth(home)
    stalls, statuses = [], set[str]()
    with growth.sampled():
        for _ in range(pairs):
            control = measure(url + ACTION, BODY, seconds, headers)
            with _attack(name, url, grpc_address, token):
                probe = measure(url + ACTION, BODY, seconds, headers)
            stalls.append(probe.longest - control.longest)
            statuses |= {*control.statuses, *probe.statuses}
    note = f"{min(stalls):.3f} to {max(stalls):.3f} s"
    yield Target(f"{name}, {who}: stall", round(median(stalls), 3), "s", at_most=STALL[who], note=note)
    grown = math.inf if growth.lost else round(growth.largest / 2**20, 1)
    yield Target(f"{name}, {who}: growth of a replica", grown, "MB", at_most=None if token else GROWTH)
    failed = statuses - {"200", "429"}  # a replica may refuse requests while other programs use the machine
    note = ", ".join(sorted(statuses))
    yield Target(f"{name}, {who}: other statuses of the probe", len(failed), at_most=0, note=note)


@contextmanager
def _attack(name: str, url: str, grpc_address: str, token: str) -> Iterator[None]:
    """Run the attack while the context is active."""
    command = ["nice", sys.executable, "-m", f"benchmarks.attacks.{name}", url, grpc_address, token]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        try:
            if not process.stdout.readline():
                raise RuntimeError(f"the attack {name} did not start")
            yield
        finally:
            process.kill()


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Attack with and without a key."""
    seconds, pairs = (2.0, 1) if quick else (6.0, 5)
    (grpc_port,) = free_ports(1, "127.0.0.1")
    with published() as registry:
        _, key = registry.keys.create("probe", ["act"])
        _, limited = registry.keys.create("attacker", ["act"], rate=RATE)
        runs = [(name, token) for name in chosen(parts, dict.fromkeys(ATTACKS)) for token in ("", limited)]
        for insecure in (False, True):
            attacks = [run for run in runs if (run[0] in NEED_ACCESS and not run[1]) == insecure]
            if not attacks:
                continue
            with running(registry.storage, grpc_port=grpc_port, replicas=REPLICAS, insecure=insecure) as url:
                for name, token in attacks:
                    address = f"127.0.0.1:{grpc_port}"
                    yield from attacked(name, url, address, token, key, registry.storage.home, seconds, pairs)
