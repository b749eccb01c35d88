import numpy as np
import pytest
from scipy.stats import ttest_1samp

from evaluation.statistics.payoff import paired_difference, student_interval
from league.results.records import Game, Match
from tests.support.closeness import close

GAPS = (1.0, 2.5, -0.5, 3.0, 0.25)


def match(position: int, gap: float, alone: bool) -> Match:
    """A block in which contestant 0 gets `gap` more, on a seed with the value `position`."""
    own, other = position + gap, float(position)
    if alone:
        games = (Game((0,), 1, (), (), (own, None), (1.0, None)), Game((1,), 1, (), (), (None, other), (None, 0.0)))
    else:
        games = tuple(Game((i, 1 - i), 1, (), (), (own, other), (1.0, 0.0)) for i in range(2))
    return Match(f"s/{position}", "league", "s", position, ("a", "b"), 1, "digest", games)


@pytest.mark.parametrize("alone", [True, False])
def test_differences_are_paired_by_block(alone: bool) -> None:
    matches = [match(position, gap, alone) for position, gap in enumerate(GAPS)]
    interval = ttest_1samp(GAPS, 0).confidence_interval()
    gap = paired_difference(matches, "a")
    assert gap is not None
    assert (gap.mean, gap.low, gap.high) == pytest.approx((np.mean(GAPS), interval.low, interval.high))
    other = paired_difference(matches, "b")
    assert other is not None
    assert (other.mean, other.low, other.high) == pytest.approx((-gap.mean, -interval.high, -interval.low))


def test_one_block_has_no_interval_and_none_has_no_difference() -> None:
    assert paired_difference([], "a") is None
    single = student_interval([2.0])
    assert close((single.mean, single.low, single.high), (2.0, None, None))


def test_intervals_have_their_coverage() -> None:
    """Of 5,000 series of 8 blocks, 95 % of the intervals contain the mean, up to three binomial standard errors."""
    values = np.random.default_rng(1).normal(3.0, 2.0, size=(5000, 8))
    covered = sum(
        low <= 3.0 <= high for low, high in ((s.low, s.high) for s in map(student_interval, values)) if low and high
    )
    assert covered / 5000 == pytest.approx(0.95, abs=3 * np.sqrt(0.05 * 0.95 / 5000))
