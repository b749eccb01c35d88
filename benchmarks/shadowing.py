"""What does a shadow cost clients?

One league with a champion and a candidate of the same size, served as by deploy.yaml, at half of the maximum rate of
the server: the median latency with all requests mirrored to the candidate divided by that without, in successive pairs
of runs, of which the median counts.
"""

from collections.abc import Iterator
from statistics import median

from benchmarks.harness import Quick, Target
from benchmarks.leagues.served_league import ACTION, BODY, LEAGUE, served
from benchmarks.load.http import measure
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from tests.support.waiting import until

CLIENTS = 8
REPLICAS = 2
SLOWER = 1.1


def main(quick: Quick = False, pairs: int = 5, seconds: float = 8.0) -> Iterator[Target]:
    """Measure the pairs."""
    pairs, seconds = (1, 2.0) if quick else (pairs, seconds)
    ratios = []
    with served(2, replicas=REPLICAS) as (url, registry):
        rate = measure(url + ACTION, BODY, connections=32, seconds=seconds / 2).rate / 2
        for _ in range(pairs):
            p50 = []
            for shadow in (None, Portion(2, 1.0)):
                _shadow(registry, shadow)
                p50.append(measure(url + ACTION, BODY, connections=CLIENTS, seconds=seconds, rate=rate).p50)
            ratios.append(p50[1] / p50[0])
        _report(registry)
    note = f"{rate:,.0f}/s; pairs {', '.join(f'{ratio:.2f}' for ratio in ratios)}"
    yield Target("p50 with a shadow", median(ratios), "×", at_most=SLOWER, peer="without", note=note)


def _shadow(registry: Registry, shadow: Portion | None) -> None:
    """Set the shadow; returns when all replicas follow."""
    setting = registry.traffic.set(LEAGUE, shadow=shadow, actor="benchmark", reason="a pair")

    def follows() -> bool:
        rows = registry.replicas.acknowledgements(LEAGUE)
        return len(rows) >= REPLICAS and all(row.traffic == setting.id for row in rows)

    until(follows, 30)


def _report(registry: Registry) -> None:
    """Print which part of the load the candidate has received: it is limited to its share of a core."""
    (counts,) = registry.traffic.shadow_counts(LEAGUE)
    offered = counts.requests + counts.dropped
    print(f"of {offered:,} requests {counts.requests:,} were computed by the candidate, ", end="")
    print(f"{counts.dropped:,} were dropped ({counts.dropped / offered:.0%}); agreement {counts.agreement:.1%}")
