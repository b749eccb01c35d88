"""Does the service withstand hostile callers, slow storage and lost connections?

unauthenticated    calls without a key, with the longest names over HTTP and gRPC: memory of the replicas
bodies             a key limited to 10 requests/s sends the worst bodies of 4 MB: latency of the others
versions           200 callers request 200 numbered versions: time from a promotion to every replica
confirmations      `--wait` while one of three replicas is stuck, cut off, or has a wrong clock
database           the connection of a replica to PostgreSQL drops all packets for a while (requires root)
fuzz               generated requests to replicas with SQLite and with PostgreSQL: do the responses differ?
locks              nightly runs whose lock connection is terminated while another run waits
"""

from collections.abc import Callable, Iterator

from benchmarks.attacks.confirmations import confirmations
from benchmarks.attacks.databases import databases
from benchmarks.attacks.large_bodies import large_bodies
from benchmarks.attacks.lost_database import lost_database
from benchmarks.attacks.lost_lock import lost_locks
from benchmarks.attacks.numbered_versions import numbered_versions
from benchmarks.attacks.unauthenticated import unauthenticated
from benchmarks.harness import Parts, Quick, Target, chosen
from benchmarks.leagues.served_league import served
from serve_app.runtime.haproxy import free_ports

REPLICAS = 2


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Measure the cases."""
    cases: dict[str, Callable[[], Iterator[Target]]] = {
        "unauthenticated": lambda: _unauthenticated(400 if quick else 4096),
        "bodies": lambda: _bodies(2.0 if quick else 20.0, 1 if quick else 3),
        "versions": lambda: _versions(*(20, 10) if quick else (200, 100)),
        "confirmations": lambda: confirmations(4 if quick else 34),
        "database": lambda: lost_database(10.0 if quick else 60.0, 1 if quick else 3),
        "locks": lambda: lost_locks(2 if quick else 20),
        "fuzz": lambda: databases(1_000 if quick else 10_000),
    }
    for case in chosen(parts, cases).values():
        yield from case()


def _unauthenticated(calls: int) -> Iterator[Target]:
    (grpc_port,) = free_ports(1, "127.0.0.1")
    with served(grpc_port=grpc_port, replicas=REPLICAS) as (url, registry):
        registry.keys.create("caller", ["act"])
        yield from unauthenticated(url, f"127.0.0.1:{grpc_port}", calls, registry.storage.home)


def _bodies(seconds: float, pairs: int) -> Iterator[Target]:
    with served(replicas=REPLICAS) as (url, registry):
        _, token = registry.keys.create("caller", ["act"])
        yield from large_bodies(url, registry, token, seconds, pairs)


def _versions(versions: int, promotions: int) -> Iterator[Target]:
    with served(versions, replicas=REPLICAS) as (url, registry):
        _, token = registry.keys.create("caller", ["act"])
        yield numbered_versions(url, registry, token, versions, promotions)
