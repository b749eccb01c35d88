"""Short forms of `benchmarks.hostile`, `benchmarks.one_caller` and `benchmarks.fuzz`, of which many share a server.

Targets in seconds, and ratios of durations, depend on the speed of the machine: only the benchmarks compare them.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.attacks.confirmations import confirmations
from benchmarks.attacks.invalid_requests import invalid_requests
from benchmarks.attacks.large_bodies import large_bodies
from benchmarks.attacks.lost_lock import lost_locks
from benchmarks.attacks.unauthenticated import unauthenticated
from benchmarks.harness import Target
from benchmarks.leagues.served_league import served
from benchmarks.one_caller import RATE, attacked
from league.registry.registry import Registry
from serve_app.runtime.haproxy import free_ports

pytestmark = pytest.mark.slow
SECONDS = 2.0
"""Duration of an attack."""


@dataclass(frozen=True)
class Server:
    """A server that is attacked. key: of other callers."""

    url: str
    grpc: str
    registry: Registry
    key: str

    @property
    def home(self) -> Path:
        """LEAGUE_HOME of the server."""
        return self.registry.storage.home

    def attacked(self, name: str, *, keyed: bool = False) -> Iterator[Target]:
        """What `benchmarks.one_caller` measures. keyed: the attacker has a key, which nobody has used before."""
        token = self.registry.keys.create(name.replace("_", "-"), ["act"], rate=RATE)[1] if keyed else ""
        return attacked(name, self.url, self.grpc, token, self.key, self.home, SECONDS, 1)


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    """Two replicas that require a key."""
    (port,) = free_ports(1, "127.0.0.1")
    with served(grpc_port=port, replicas=2) as (url, registry):
        yield with_key(url, port, registry)


@pytest.fixture(scope="module")
def open_server() -> Iterator[Server]:
    """One replica that requires no key."""
    (port,) = free_ports(1, "127.0.0.1")
    with served(2, grpc_port=port, replicas=1, insecure=True) as (url, registry):
        yield with_key(url, port, registry)


def with_key(url: str, port: int, registry: Registry) -> Server:
    _, key = registry.keys.create("caller", ["act"])
    return Server(url, f"127.0.0.1:{port}", registry, key)


def withstood(targets: Iterable[Target]) -> None:
    """Assert that there are targets, and that those that do not depend on the speed of the machine are met."""
    targets = list(targets)
    assert targets
    assert [str(target) for target in targets if target.unit not in ("s", "×") and not target.met] == []


def test_confirmations_beside_a_silent_replica() -> None:
    withstood(confirmations(4))


def test_lost_locks() -> None:
    withstood(lost_locks(2))


def test_calls_without_a_key(server: Server) -> None:
    """The first test of this server: its replicas may grow least."""
    list(unauthenticated(server.url, server.grpc, 100, server.home))  # takes the memory that is taken once
    withstood(unauthenticated(server.url, server.grpc, 400, server.home))


def test_messages_of_grpc_without_a_key(server: Server) -> None:
    withstood(server.attacked("grpc_messages"))


@pytest.mark.parametrize("name", ["grpc_messages", "websocket_pings"])
def test_a_caller_with_a_limited_key(server: Server, name: str) -> None:
    withstood(server.attacked(name, keyed=True))


def test_large_bodies(server: Server) -> None:
    withstood(large_bodies(server.url, server.registry, server.key, SECONDS, 1))


def test_pings_of_streams_without_a_key(open_server: Server) -> None:
    withstood(open_server.attacked("websocket_pings"))


def test_invalid_requests(open_server: Server) -> None:
    """The same requests twice: a replica may grow by the first, in which it takes memory that it keeps."""
    list(invalid_requests(open_server.url, open_server.home, 500))
    withstood(invalid_requests(open_server.url, open_server.home, 500))
