from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.statistics.alpha_spending import alpha_per_verdict, alpha_share, alpha_spent


@given(st.lists(st.integers(1, 20), min_size=1, max_size=365), st.floats(1e-6, 0.5))
def test_a_year_spends_at_most_alpha(candidates: list[int], alpha: float) -> None:
    assert sum(count * alpha_per_verdict(count, alpha) for count in candidates) <= alpha * (1 + 1e-9)


def test_each_night_has_the_same_alpha() -> None:
    assert alpha_per_verdict(8, 0.05) == pytest.approx(0.05 / 365 / 8)


@pytest.mark.parametrize("arguments", [(0, 0.05), (1, 0.0), (1, 1.0), (1, 0.05, 0)])
def test_invalid_arguments_are_rejected(arguments: tuple[int, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        alpha_per_verdict(*arguments)


NOW = datetime(2026, 1, 1, tzinfo=UTC)


@given(st.lists(st.tuples(st.integers(1, 8), st.floats(0, 400)), max_size=900), st.integers(1, 1000))
def test_no_365_days_spend_more_than_alpha(gaps: list[tuple[int, float]], nights: int) -> None:
    """Runs at any times, with any number of candidates, and a `nights` that may be far too small."""
    now, verdicts = NOW, []
    for candidates, hours in gaps:
        now += timedelta(hours=hours)
        part = alpha_share(candidates, 0.05, nights, alpha_spent(verdicts, now))
        assert 0 <= part <= 0.05 / nights / candidates
        verdicts += [(now, part)] * candidates
        assert alpha_spent(verdicts, now) <= 0.05 * (1 + 1e-9)


def test_alpha_spent_more_than_a_year_ago_is_ignored() -> None:
    old, new = (NOW - timedelta(days=366), 0.03), (NOW - timedelta(days=364), 0.04)
    assert alpha_spent([old, new], NOW) == pytest.approx(0.04)
    assert alpha_share(2, 0.05, 1, 0.04) == pytest.approx(0.005)
    assert alpha_share(2, 0.05, 1, 0.06) == pytest.approx(0.0, abs=0.0)
