"""Random choices at the edges of what a generator gives."""

from typing import Any, cast

import numpy as np
import pytest

from league.errors import InvalidInput
from league.policies.draws import choose, draw, sample


class Fixed:
    """A generator of one number."""

    def __init__(self, number: float) -> None:
        self._number = number

    def random(self, shape: Any = None) -> Any:
        return self._number if shape is None else np.full(shape, self._number)


def fixed(*numbers: float) -> list[np.random.Generator]:
    return [cast(np.random.Generator, Fixed(number)) for number in numbers]


LOWEST, HIGHEST = 0.0, 1 - 2**-53


def test_the_least_and_the_greatest_number_choose_what_is_allowed() -> None:
    allowed = np.array([[0, 0, 1, 1, 0]] * 4, np.int8)
    assert choose(allowed, fixed(LOWEST, 0.4999, 0.5, HIGHEST)).tolist() == [2, 2, 3, 3]


def test_the_least_and_the_greatest_number_sample_what_is_possible() -> None:
    logits = np.array([[-1e9, 0.0, np.log(3.0), -1e9]] * 4, np.float32)
    assert sample(logits, fixed(LOWEST, 0.2499, 0.2501, HIGHEST)).tolist() == [1, 1, 2, 2]


def test_huge_and_infinite_logits_are_sampled() -> None:
    logits = np.array([[1e30, -np.inf, 1e30], [-np.inf, -3e38, -np.inf]], np.float32)
    assert sample(logits, fixed(HIGHEST, LOWEST)).tolist() == [2, 1]


def test_a_row_draws_from_its_own_generator() -> None:
    assert draw(fixed(0.25, 0.75), 2).tolist() == [0.25, 0.75]
    assert draw(fixed(0.25, 0.75), 2, (2,)).tolist() == [[0.25, 0.25], [0.75, 0.75]]
    assert draw([], 0, (2,)).shape == (0, 2)
    with pytest.raises(InvalidInput, match="3 rows needs rng, one generator per row: got 2"):
        draw(fixed(0.25, 0.75), 3)
