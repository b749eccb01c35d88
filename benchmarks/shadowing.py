"""What does a shadow cost those who are being served?

One league, a champion and a candidate of the same size, as deploy.yaml serves them, at half of the rate that the server
can answer: the median latency with every request shown to the candidate over that without, in pairs of runs one behind
the other, of which the median counts.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

from benchmarks.load import measure
from benchmarks.served_league import BODY, LEAGUE, publish
from league.registry.registry import Registry
from league.registry.rows import Portion
from serve_app.launch import running

CLIENTS = 8
REPLICAS = 2
SLOWER = 1.1


def main() -> int:
    """Print the pairs; 1 if the target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--quick", action="store_true", help="one short pair: shows that it works, no more")
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
            _tell(registry)
        registry.close()
    print(f"p50 with a shadow of all requests over without: {median(ratios):.2f}×   (at most {SLOWER:g}×)")
    return int(median(ratios) > SLOWER)


def _shadow(registry: Registry, shadow: Portion | None) -> None:
    """Return when every replica follows."""
    setting = registry.set_traffic(LEAGUE, shadow=shadow, actor="benchmark", reason="a pair")
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        said = registry.acknowledgements(LEAGUE)
        if len(said) >= REPLICAS and all(one.traffic == setting.id for one in said):
            return
        time.sleep(0.02)
    raise TimeoutError("the replicas do not follow within 30 s")


def _tell(registry: Registry) -> None:
    """How much of the load the candidate has seen: it gets what fits into its share of a core."""
    (seen,) = registry.shadowings(LEAGUE)
    offered = seen.requests + seen.dropped
    print(f"of {offered:,} requests {seen.requests:,} were computed by the candidate, ", end="")
    print(f"{seen.dropped:,} were dropped ({seen.dropped / offered:.0%}); agreement {seen.agreement:.1%}")


if __name__ == "__main__":
    sys.exit(main())
