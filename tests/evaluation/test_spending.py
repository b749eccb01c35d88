from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.spending import share, spent, spent_by


@given(st.lists(st.integers(1, 20), min_size=1, max_size=365), st.floats(1e-6, 0.5))
def test_a_year_spends_no_more_than_it_has(candidates: list[int], alpha: float) -> None:
    assert sum(count * spent_by(count, alpha) for count in candidates) <= alpha * (1 + 1e-9)


def test_the_last_night_has_as_much_as_the_first() -> None:
    assert spent_by(8, 0.05) == pytest.approx(0.05 / 365 / 8)


@pytest.mark.parametrize("arguments", [(0, 0.05), (1, 0.0), (1, 1.0), (1, 0.05, 0)])
def test_nothing_is_shared_by_nobody(arguments: tuple[int, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        spent_by(*arguments)


NOW = datetime(2026, 1, 1, tzinfo=UTC)


@given(st.lists(st.tuples(st.integers(1, 8), st.floats(0, 400)), max_size=900), st.integers(1, 1000))
def test_no_365_days_spend_more_than_alpha_however_many_nights_there_are(
    gaps: list[tuple[int, float]], nights: int
) -> None:
    """Nights at any hours, with any number of candidates, against a `nights` that may be far too small."""
    now, verdicts = NOW, []
    for candidates, hours in gaps:
        now += timedelta(hours=hours)
        part = share(candidates, 0.05, nights, spent(verdicts, now))
        assert 0 <= part <= 0.05 / nights / candidates
        verdicts += [(now, part)] * candidates
        assert spent(verdicts, now) <= 0.05 * (1 + 1e-9)


def test_what_is_older_than_a_year_is_spent_no_more() -> None:
    old, new = (NOW - timedelta(days=366), 0.03), (NOW - timedelta(days=364), 0.04)
    assert spent([old, new], NOW) == 0.04
    assert share(2, 0.05, 1, 0.04) == pytest.approx(0.005)
    assert share(2, 0.05, 1, 0.06) == 0
