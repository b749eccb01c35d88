"""What does a version cost a replica: time to load, memory, and is memory constant over many swaps?

One replica behind HAProxy. A version with a network of 1 MB is requested by number for the first time, and again: the
difference is the time for finding it in the registry, verifying, loading and warming up. A killed replica restarts:
from the start of its process to its first acknowledgement. A hundred versions of the 2×256 network are held at once;
and versions are promoted in turn without room for versions that are not live, so that each of them is loaded again.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import httpx
import psutil
import yaml

from benchmarks.leagues.served_league import BODY, LEAGUE, publish
from benchmarks.processes import replica_processes
from league.registry.registry import Registry
from serve_app.runtime.launch import DEPLOY_YAML, running

LARGE = (448, 448)
"""Units of a network of 1 MB."""
TO_LOAD = 20.0
"""Milliseconds."""
TO_START = 3.0
"""Seconds."""
POLICIES, MORE = 100, 150.0
"""Maximum additional memory of this number of policies, in MB."""
SWAPS, GROWTH = 10_000, 0.02
WARM = 0.1
"""Fraction of the swaps after which memory is first measured, when allocators have reached their size."""


def main() -> int:
    """Print the measurements; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--swaps", type=int, default=SWAPS)
    parser.add_argument("--quick", action="store_true", help="smoke test: few of each")
    options = parser.parse_args()
    times, policies, swaps = (3, 10, 100) if options.quick else (20, POLICIES, options.swaps)
    met = [_loading(times), _starting(1 if options.quick else 5), _holding(policies), _swapping(swaps)]
    return int(not all(met))


def _loading(times: int) -> bool:
    with _served(times + 1, LARGE) as (url, registry):
        size = registry.artifacts.path(LEAGUE, 1) / "shared.onnx"
        taken = []
        with httpx.Client(base_url=url) as client:
            for number in range(2, times + 2):
                first, again = _act(client, number), min(_act(client, number) for _ in range(3))
                taken.append((first - again) * 1e3)
        print(f"load and warm {size.stat().st_size / 1e6:.2f} MB: median {median(taken):.1f} ms, ", end="")
        print(f"longest {max(taken):.1f} ms   (median at most {TO_LOAD:g} ms)", flush=True)
    return median(taken) <= TO_LOAD


def _act(client: httpx.Client, number: int) -> float:
    start = time.perf_counter()
    client.post(f"/v1/policies/{LEAGUE}/action?version={number}", content=BODY).raise_for_status()
    return time.perf_counter() - start


def _starting(times: int) -> bool:
    taken = []
    with _served(1) as (_, registry):
        for _ in range(times):
            (old,) = replica_processes()
            known = {said.replica for said in registry.replicas.acknowledgements(LEAGUE)}
            old.kill()
            taken.append(_ready(registry, known))
    print(f"replica ready after its process started: median {median(taken):.2f} s, longest {max(taken):.2f} s", end="")
    print(f"   (median at most {TO_START:g} s)", flush=True)
    return median(taken) <= TO_START


def _ready(registry: Registry, known: set[str]) -> float:
    """Seconds from the start of a new replica's process to its first acknowledgement."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        if {said.replica for said in registry.replicas.acknowledgements(LEAGUE)} - known:
            now = time.time()
            return now - max(process.create_time() for process in replica_processes())
        time.sleep(0.005)
    raise TimeoutError("no replica came back within 60 s")


def _holding(policies: int) -> bool:
    with _served(policies, cached_versions=policies) as (url, _), httpx.Client(base_url=url) as client:
        (replica,) = replica_processes()
        _act(client, 1)
        before = _resident(replica)
        for number in range(1, policies + 1):
            _act(client, number)
        more = _resident(replica) - before
    print(f"{policies} policies in one replica: {before:.0f} MB with one, {more:+.0f} MB   (at most +{MORE:g} MB)")
    return more <= MORE


def _swapping(swaps: int) -> bool:
    with _served(4, cached_versions=1, poll=0.002) as (_, registry):
        (replica,) = replica_processes()
        sizes, start = [], time.monotonic()
        for done in range(1, swaps + 1):
            _promote(registry, 1 + done % 4)
            if done in (int(swaps * WARM), swaps):
                sizes.append(_resident(replica))
        rate = swaps / (time.monotonic() - start)
    growth = sizes[1] / sizes[0] - 1
    print(f"{swaps:,} swaps, each loaded anew, {rate:.0f}/s: {sizes[0]:.1f} MB after a tenth of them, ", end="")
    print(f"{sizes[1]:.1f} MB at the end, {growth:+.2%}   (at most {GROWTH:+.0%})")
    return growth <= GROWTH


def _promote(registry: Registry, version: int) -> None:
    expected = registry.aliases.current(LEAGUE)["champion"]
    registry.aliases.set(LEAGUE, "champion", version, expected=expected, actor="benchmark", reason="in turn")
    deadline = time.monotonic() + 30
    while not any(said.version == version for said in registry.replicas.acknowledgements(LEAGUE)):
        if time.monotonic() > deadline:
            raise TimeoutError(f"version {version} did not reach the replica within 30 s")
        time.sleep(0.001)


def _resident(process: psutil.Process) -> float:
    """Resident memory in MB."""
    return float(process.memory_info().rss) / 1e6


@contextmanager
def _served(versions: int, hidden: tuple[int, int] = (256, 256), **settings: float) -> Iterator[tuple[str, Registry]]:
    """One replica with changed settings."""
    document = yaml.safe_load(DEPLOY_YAML.read_text())
    document["applications"][0]["args"] |= settings
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch) / "home", versions=versions, hidden=hidden)
        deploy = Path(scratch) / "deploy.yaml"
        deploy.write_text(yaml.safe_dump(document))
        with running(registry.storage, replicas=1, deploy=deploy) as url:
            yield url, registry
        registry.close()


if __name__ == "__main__":
    sys.exit(main())
