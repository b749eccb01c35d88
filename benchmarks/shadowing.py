"""What does a shadow cost clients?

One league with a champion and a candidate of the same size, served as by deploy.yaml, at half of the maximum rate of
the server: the median latency with all requests mirrored to the candidate divided by that without, in successive pairs
of runs, of which the median counts.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from benchmarks.leagues.served_league import BODY, LEAGUE, publish
from benchmarks.load.http import measure
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from serve_app.runtime.launch import running

CLIENTS = 8
REPLICAS = 2
SLOWER = 1.1


def main() -> int:
    """Print the pairs; 1 if the target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--quick", action="store_true", help="smoke test: one short pair")
    options = parser.parse_args()
    pairs, seconds = (1, 2.0) if options.quick else (options.pairs, options.seconds)
    ratios = []
    with tempfile.TemporaryDirectory() as scratch:
        registry = publish(Path(scratch) / "home", versions=2)
        with running(registry.storage, replicas=REPLICAS) as url:
            address = f"{url}/v1/policies/{LEAGUE}/action"
            rate = measure(address, BODY, connections=32, seconds=seconds / 2).rate / 2
            for number in range(pairs):
                _shadow(registry, None)
                alone = measure(address, BODY, connections=CLIENTS, seconds=seconds, rate=rate)
                _shadow(registry, Portion(2, 1.0))
                shadowed = measure(address, BODY, connections=CLIENTS, seconds=seconds, rate=rate)
                ratios.append(shadowed.p50 / alone.p50)
                print(f"pair {number + 1}, {rate:,.0f}/s: p50 {alone.p50:.3f} ms without a shadow, ", end="")
                print(f"{shadowed.p50:.3f} ms with one: {ratios[-1]:.2f}×", flush=True)
            _report(registry)
        registry.close()
    print(f"p50 with a shadow of all requests over without: {median(ratios):.2f}×   (at most {SLOWER:g}×)")
    return int(median(ratios) > SLOWER)


def _shadow(registry: Registry, shadow: Portion | None) -> None:
    """Set the shadow; returns when all replicas follow."""
    setting = registry.traffic.set(LEAGUE, shadow=shadow, actor="benchmark", reason="a pair")
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        said = registry.replicas.acknowledgements(LEAGUE)
        if len(said) >= REPLICAS and all(one.traffic == setting.id for one in said):
            return
        time.sleep(0.02)
    raise TimeoutError("the replicas do not follow within 30 s")


def _report(registry: Registry) -> None:
    """Print which part of the load the candidate has received: it is limited to its share of a core."""
    (counts,) = registry.traffic.shadow_counts(LEAGUE)
    offered = counts.requests + counts.dropped
    print(f"of {offered:,} requests {counts.requests:,} were computed by the candidate, ", end="")
    print(f"{counts.dropped:,} were dropped ({counts.dropped / offered:.0%}); agreement {counts.agreement:.1%}")


if __name__ == "__main__":
    sys.exit(main())
