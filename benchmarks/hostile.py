"""Does the service withstand hostile callers, slow storage and lost connections?

unauthenticated    calls without a key, with the longest names over HTTP and gRPC: memory of the replicas
bodies             a key limited to 10 requests/s sends the worst bodies of 4 MB: latency of the others
versions           200 callers request 200 numbered versions: time from a promotion to every replica
confirmations      `--wait` while one of three replicas is stuck, cut off, or has a wrong clock
database           the connection of a replica to PostgreSQL drops all packets for a while (requires root)
fuzz               generated requests to replicas with SQLite and with PostgreSQL: do the responses differ?
locks              nightly runs whose lock connection is terminated while another run waits
"""

import argparse
import sys
import tempfile
from pathlib import Path

from benchmarks.attacks.confirmations import confirmations
from benchmarks.attacks.databases import databases
from benchmarks.attacks.large_bodies import large_bodies
from benchmarks.attacks.lost_database import lost_database
from benchmarks.attacks.lost_lock import lost_locks
from benchmarks.attacks.numbered_versions import numbered_versions
from benchmarks.attacks.unauthenticated import unauthenticated
from benchmarks.leagues.served_league import publish
from serve_app.runtime.haproxy import free_ports
from serve_app.runtime.launch import running

REPLICAS = 2
ON_SERVER = ("unauthenticated", "bodies", "versions")
CASES = (*ON_SERVER, "confirmations", "database", "locks", "fuzz")


def main() -> int:
    """Print a line for each case; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=CASES, action="append", help="a case; may be repeated")
    parser.add_argument("--quick", action="store_true", help="smoke test: a tenth of the calls, short runs")
    options = parser.parse_args()
    wanted, quick = options.only or CASES, options.quick
    met = []
    if any(case in wanted for case in ON_SERVER):
        met += _on_server([case for case in wanted if case in ON_SERVER], quick)
    if "confirmations" in wanted:
        met.append(confirmations(4 if quick else 34))
    if "database" in wanted:
        met.append(lost_database(10.0 if quick else 60.0, 1 if quick else 3))
    if "locks" in wanted:
        met.append(lost_locks(2 if quick else 20))
    if "fuzz" in wanted:
        met.append(databases(1_000 if quick else 10_000))
    return int(not all(met))


def _on_server(cases: list[str], quick: bool) -> list[bool]:
    versions = 20 if quick else 200
    (grpc_port,) = free_ports(1, "127.0.0.1")
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch) / "home", versions=versions if "versions" in cases else 2)
        _, token = registry.keys.create("caller", ["act"])
        met = []
        with running(registry.storage, grpc_port=grpc_port, replicas=REPLICAS) as url:
            if "unauthenticated" in cases:
                met.append(unauthenticated(url, f"127.0.0.1:{grpc_port}", 400 if quick else 4096))
            if "bodies" in cases:
                met.append(large_bodies(url, registry, token, 2.0 if quick else 20.0, 1 if quick else 3))
            if "versions" in cases:
                met.append(numbered_versions(url, registry, token, versions, 10 if quick else 100))
        registry.close()
    return met


if __name__ == "__main__":
    sys.exit(main())
