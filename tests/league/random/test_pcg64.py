from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from league.random import pcg64
from league.random.pcg64 import generate_state

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


words = st.integers(0, 2**32 - 1)


@given(st.lists(st.tuples(st.integers(0, 2**63 - 1), words, words), max_size=5), words)
def test_each_seed_may_have_its_own_spawn_key(rows: list[tuple[int, int, int]], common: int) -> None:
    seeds, first, second = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    expected = [
        np.random.SeedSequence(seed, spawn_key=(a, common, b)).generate_state(4, np.uint64).tolist()
        for seed, a, b in rows
    ]
    assert generate_state(seeds, [first, common, second]).T.tolist() == expected


def test_draws_equal_those_of_numpy() -> None:
    for low, high in ((-1.0, 1.0), (-0.9, 0.9), (0.3, 7.7)):
        expected = with_numpy(lambda rng, low=low, high=high: rng.uniform(low, high, 6))
        np.testing.assert_array_equal(pcg64.uniform(pcg64.outputs(SEEDS, 6), low, high), expected)
    (output,) = pcg64.outputs(SEEDS, 1)
    for most in (2, 3, 4, 5, 1000, 2**31):
        drawn, accepted = pcg64.integers(np.stack([output, output >> 32]), most)
        assert accepted.all()
        np.testing.assert_array_equal(drawn, with_numpy(lambda rng, most=most: [rng.integers(most) for _ in range(2)]))


def test_integers_that_numpy_draws_again_are_not_accepted() -> None:
    (output,) = pcg64.outputs(SEEDS, 1)
    drawn, accepted = pcg64.integers(output, 2**31 + 1)
    assert 0.4 < accepted.mean() < 0.6
    values = with_numpy(lambda rng: rng.integers(2**31 + 1))
    np.testing.assert_array_equal(drawn[accepted], values[accepted])
    assert (drawn[~accepted] != values[~accepted]).all()
    # Lemire's method rejects 2³² mod 3 = 1 of the 32-bit outputs, which is 0.
    drawn, accepted = pcg64.integers(np.array([0, 1, 2**32 - 1], dtype=np.uint64), 3)
    assert accepted.tolist() == [False, True, True]
    assert drawn.tolist() == [0, 0, 2]
