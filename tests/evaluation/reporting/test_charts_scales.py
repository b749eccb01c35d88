import pytest

from evaluation.reporting.charts import Scale, apart, padded


def test_a_scale_maps_its_range() -> None:
    scale = Scale(-50, 150, start=300, end=100)
    assert (scale.at(-50), scale.at(150), scale.at(50)) == (300, 100, 200)


@pytest.mark.parametrize(
    ("low", "high", "about", "ticks"),
    [
        (0, 10, 5, [0, 2, 4, 6, 8, 10]),
        (-3.3, 3.3, 5, [-2, 0, 2]),
        (-120, 430, 6, [-100, 0, 100, 200, 300, 400]),
        (0, 0.09, 4, [0, 0.05]),
    ],
)
def test_ticks_are_round_numbers_within_the_range(low: float, high: float, about: int, ticks: list[float]) -> None:
    assert Scale(low, high, 0, 1).ticks(about) == pytest.approx(ticks)


def test_ticks_of_counts_are_integers() -> None:
    assert Scale(1, 3, 0, 1).ticks(8, whole=True) == [1, 2, 3]


def test_a_single_value_gets_padding() -> None:
    assert padded(5, 5, least=2) == (4, 6)
    assert padded(0, 100, 0.1) == (-10, 110)


def test_labels_are_kept_apart_in_their_order() -> None:
    assert apart([100, 20, 104, 101], 15) == [100, 20, 130, 115]
