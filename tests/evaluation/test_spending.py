import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.spending import spent_by


@given(st.lists(st.integers(1, 20), min_size=1, max_size=365), st.floats(1e-6, 0.5))
def test_a_year_spends_no_more_than_it_has(candidates: list[int], alpha: float) -> None:
    assert sum(count * spent_by(count, alpha) for count in candidates) <= alpha * (1 + 1e-9)


def test_the_last_night_has_as_much_as_the_first() -> None:
    assert spent_by(8, 0.05) == pytest.approx(0.05 / 365 / 8)


@pytest.mark.parametrize("arguments", [(0, 0.05), (1, 0.0), (1, 1.0), (1, 0.05, 0)])
def test_nothing_is_shared_by_nobody(arguments: tuple[int, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        spent_by(*arguments)
