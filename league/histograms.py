"""Latency histograms with fixed buckets, which can be merged and queried for quantiles."""

from bisect import bisect_left
from collections.abc import Iterable, Sequence

BOUNDS = (
    25, 50, 75, 100, 150, 200, 300, 500, 750,
    1_000, 2_000, 5_000, 10_000, 25_000, 50_000, 100_000, 250_000, 1_000_000, 5_000_000,
)  # fmt: skip
"""Upper bounds of the buckets, in microseconds. One more bucket holds larger values."""
_NANOSECONDS = tuple(1000 * bound for bound in BOUNDS)


class Histogram:
    """Counts per bucket, and the sum of all values in nanoseconds."""

    __slots__ = ("counts", "ns")

    def __init__(self, counts: Iterable[int] = (), ns: int = 0) -> None:
        self.counts = list(counts) or [0] * (len(BOUNDS) + 1)
        self.ns = ns

    def add(self, ns: int) -> None:
        """Add a duration in nanoseconds."""
        self.counts[bisect_left(_NANOSECONDS, ns)] += 1
        self.ns += ns

    def merge(self, counts: Sequence[int], ns: int) -> None:
        """Add the counts and the sum of another histogram."""
        self.counts = [count + other_count for count, other_count in zip(self.counts, counts, strict=True)]
        self.ns += ns

    @property
    def count(self) -> int:
        """Number of values."""
        return sum(self.counts)

    def quantile(self, share: float) -> float | None:
        """Return an upper bound of a quantile in milliseconds: the bound of its bucket.

        None if the histogram is empty; infinity in the last bucket.
        """
        rank, cumulative_count = share * self.count, 0
        if not self.count:
            return None
        for bound, count in zip(BOUNDS, self.counts, strict=False):
            cumulative_count += count
            if cumulative_count >= rank:
                return bound / 1000
        return float("inf")
