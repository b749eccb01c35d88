import numpy as np
import pytest
from scipy.stats import ttest_1samp

from evaluation.statistics.payoff import crossed_interval, paired_difference, student_interval
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


def test_without_an_effect_of_rows_the_crossed_interval_is_students() -> None:
    values = np.tile(GAPS, (3, 1))
    assert close(crossed_interval(values), student_interval(GAPS))
    assert close(crossed_interval(values.T), student_interval(GAPS))


def test_the_crossed_interval_counts_rows_and_columns() -> None:
    """With rows that differ by 1, 2 and 3 points and equal columns, it is Student's over the rows."""
    rows = np.array([1.0, 2.0, 3.0])
    assert close(crossed_interval(np.tile(rows[:, np.newaxis], (1, 5))), student_interval(rows.tolist()))
    both = crossed_interval(rows[:, np.newaxis] + np.array(GAPS))
    alone = [student_interval(each) for each in (rows.tolist(), GAPS)]
    assert both.low is not None
    assert both.high is not None
    assert both.mean == pytest.approx(sum(each.mean for each in alone))
    assert both.high - both.low > student_interval(GAPS).high - student_interval(GAPS).low  # type: ignore[operator]


def test_a_single_row_has_no_crossed_interval() -> None:
    found = crossed_interval(np.array([GAPS]))
    assert (found.mean, found.low, found.high) == (pytest.approx(np.mean(GAPS)), None, None)
    assert crossed_interval(np.zeros((2, 3))).low == 0
