from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.random import pcg64

SEEDS = np.concatenate([np.arange(1000), np.random.default_rng(0).integers(2**31, size=2000), [2**31 - 1, 2**32 - 1]])


def with_numpy(draw: Callable[[np.random.Generator], Any]) -> np.ndarray:
    """What each seed's generator draws, (…, seeds)."""
    return np.stack([draw(np.random.default_rng(int(seed))) for seed in SEEDS], axis=-1)


def test_outputs_equal_those_of_numpy() -> None:
    expected = with_numpy(lambda rng: rng.bit_generator.random_raw(20))
    np.testing.assert_array_equal(pcg64.outputs(SEEDS, 20), expected)


@given(st.lists(st.integers(0, 2**32 - 1), max_size=9), st.integers(1, 9))
def test_outputs_of_a_seed_do_not_depend_on_the_others(seeds: list[int], count: int) -> None:
    expected = [np.random.PCG64(seed).random_raw(count) for seed in seeds]
    found = pcg64.outputs(np.array(seeds, dtype=np.int64), count)
    assert found.dtype == np.uint64
    assert found.shape == (count, len(seeds))
    assert found.T.tolist() == [array.tolist() for array in expected]


@pytest.mark.parametrize(("low", "high"), [(-1.0, 1.0), (-0.9, 0.9), (0.3, 7.7)])
def test_uniform_draws_equal_those_of_numpy(low: float, high: float) -> None:
    expected = with_numpy(lambda rng: rng.uniform(low, high, 6))
    np.testing.assert_array_equal(pcg64.uniform(pcg64.outputs(SEEDS, 6), low, high), expected)


@pytest.mark.parametrize("high", [2, 3, 4, 5, 1000, 2**31])
def test_integers_equal_those_of_numpy(high: int) -> None:
    expected = with_numpy(lambda rng: [rng.integers(high), rng.integers(high)])
    (output,) = pcg64.outputs(SEEDS, 1)
    found, accepted = pcg64.integers(np.stack([output, output >> 32]), high)
    assert accepted.all()
    np.testing.assert_array_equal(found, expected)


def test_integers_that_numpy_draws_again_are_not_accepted() -> None:
    high = 2**31 + 1
    (output,) = pcg64.outputs(SEEDS, 1)
    found, accepted = pcg64.integers(output, high)
    assert 0.4 < accepted.mean() < 0.6

    values = with_numpy(lambda rng: rng.integers(high))
    np.testing.assert_array_equal(found[accepted], values[accepted])
    assert (found[~accepted] != values[~accepted]).all()


def test_the_smallest_product_is_not_accepted() -> None:
    """Lemire's method rejects 2³² mod 3 = 1 of the 32-bit outputs, which is 0."""
    halves = np.array([0, 1, 2**32 - 1], dtype=np.uint64)
    found, accepted = pcg64.integers(halves, 3)
    assert accepted.tolist() == [False, True, True]
    assert found.tolist() == [0, 0, 2]
