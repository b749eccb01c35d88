"""Latencies as counts in buckets of microseconds: cheap to add to, to merge, and to read quantiles from."""

from bisect import bisect_left
from collections.abc import Iterable, Sequence

BOUNDS = (
    25, 50, 75, 100, 150, 200, 300, 500, 750,
    1_000, 2_000, 5_000, 10_000, 25_000, 50_000, 100_000, 250_000, 1_000_000, 5_000_000,
)  # fmt: skip
"""Upper bounds of the buckets, in microseconds; a last bucket takes what took longer."""
_NANOSECONDS = tuple(1000 * bound for bound in BOUNDS)


class Histogram:
    """Counts per bucket, and the sum of all that was added, in nanoseconds."""

    __slots__ = ("counts", "ns")

    def __init__(self, counts: Iterable[int] = (), ns: int = 0) -> None:
        self.counts = list(counts) or [0] * (len(BOUNDS) + 1)
        self.ns = ns

    def add(self, ns: int) -> None:
        """Count something that took so many nanoseconds."""
        self.counts[bisect_left(_NANOSECONDS, ns)] += 1
        self.ns += ns

    def merge(self, counts: Sequence[int], ns: int) -> None:
        """Add what another has counted."""
        self.counts = [mine + other for mine, other in zip(self.counts, counts, strict=True)]
        self.ns += ns

    @property
    def count(self) -> int:
        """How often something was added."""
        return sum(self.counts)

    def quantile(self, share: float) -> float | None:
        """Milliseconds within which `share` of all was done: the bound of a bucket, so never too little.

        None without anything added; infinite beyond the last bound.
        """
        wanted, seen = share * self.count, 0
        if not self.count:
            return None
        for bound, count in zip(BOUNDS, self.counts, strict=False):
            seen += count
            if seen >= wanted:
                return bound / 1000
        return float("inf")
