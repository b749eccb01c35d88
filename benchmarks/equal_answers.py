"""Do the fast path of inference and the application give the same answers?

Generated requests of the action route and of the Open Inference Protocol with binary tensors, many of them malformed,
are sent to both paths of one replica, one to seven in the same turn of its event loop. Status, headers and body must be
equal.
"""

import random
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.harness import Quick, Target
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Replica
from tests.support.leagues.served_leagues import everything
from tests.support.servers.replicas import READ_ONLY
from tests.support.servers.two_paths import Connections, differences
from tests.support.waiting import until


def main(quick: Quick = False, requests: int = 100_000, seed: int = 0) -> Iterator[Target]:
    """Compare the answers."""
    requests, count, different = 1000 if quick else requests, 0, 0
    generator = random.Random(seed)
    with tempfile.TemporaryDirectory() as scratch:
        storage = Storage.at(Path(scratch) / "home")
        everything(storage).close()
        with Connections(Replica(Registry.open(storage), READ_ONLY, "replica")) as replica:
            until(lambda: replica.server.alias_slots.champion("board") is not None)
            while count < requests:
                number, unequal = differences(replica, generator)
                count, different = count + number, different + len(unequal)
                for fast, general in unequal:
                    print(fast, general, sep="\n", flush=True)
            share = len(replica.answered) / count
    yield Target("different answers", different, at_most=0, note=f"of {count:,}, {share:.0%} answered by the fast path")
