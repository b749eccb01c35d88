"""A token bucket allows its rate, and the requests of one second at once."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from serve_app.access.api_keys import TokenBucket


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_burst_of_one_second_is_allowed() -> None:
    clock = Clock()
    bucket = TokenBucket(5, clock)
    assert [bucket.take() for _ in range(5)] == [0] * 5
    assert bucket.take() == pytest.approx(0.2)
    clock.now += 0.21
    assert bucket.take() == 0
    assert bucket.take() > 0


def test_less_than_one_request_per_second() -> None:
    clock = Clock()
    bucket = TokenBucket(1 / 60, clock)
    assert bucket.take() == 0
    assert bucket.take() == pytest.approx(60)
    clock.now += 61
    assert bucket.take() == 0


@given(
    rate=st.floats(0.01, 1000),
    gaps=st.lists(st.floats(0, 2), min_size=1, max_size=200),
)
def test_the_rate_plus_a_burst_is_never_exceeded(rate: float, gaps: list[float]) -> None:
    clock = Clock()
    bucket = TokenBucket(rate, clock)
    begin, taken = clock.now, 0
    for gap in gaps:
        clock.now += gap
        taken += bucket.take() == 0
        assert taken <= max(1, rate) + rate * (clock.now - begin) + 1e-6


def test_tokens_can_be_owed_once() -> None:
    clock = Clock()
    bucket = TokenBucket(10, clock)
    assert bucket.take() == 0
    assert bucket.owe(109) == 0
    assert bucket.take() == pytest.approx(10.1)
    assert bucket.owe(1) == pytest.approx(10)
    clock.now += 10.15
    assert bucket.take() == 0
    assert bucket.take() > 0
