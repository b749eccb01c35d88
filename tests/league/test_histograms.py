"""Quantiles of a histogram are upper bounds."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from league.histograms import BOUNDS, Histogram

TIMES = st.lists(st.integers(0, 10**11), min_size=1, max_size=50)


def histogram_of(times: list[int]) -> Histogram:
    histogram = Histogram()
    for ns in times:
        histogram.add(ns)
    return histogram


@given(TIMES, st.floats(0.01, 1))
def test_a_quantile_is_an_upper_bound(times: list[int], share: float) -> None:
    bound = histogram_of(times).quantile(share)
    assert bound is not None
    exact = np.quantile(times, share, method="inverted_cdf") / 1e6
    assert exact <= bound
    assert bound == float("inf") or bound == BOUNDS[0] / 1000 or exact > bound / 5, "the bound is too large"


@given(TIMES, TIMES)
def test_merging_adds_the_counts(some: list[int], others: list[int]) -> None:
    merged, other = histogram_of(some), histogram_of(others)
    merged.merge(other.counts, other.ns)
    both = histogram_of(some + others)
    assert (merged.counts, merged.ns, merged.count) == (both.counts, both.ns, len(some) + len(others))


def test_an_empty_histogram_has_no_quantile() -> None:
    assert Histogram().quantile(0.5) is None


def test_a_bound_belongs_to_its_bucket() -> None:
    histogram = histogram_of([25_000, 25_001])
    assert histogram.counts[:2] == [1, 1]
    assert (histogram.quantile(0.5), histogram.quantile(0.51)) == (0.025, 0.05)
