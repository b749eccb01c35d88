"""PCG64 has the outputs of NumPy, SplitMix64 those of its reference implementation."""

from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from league.random import pcg64, splitmix64
from league.random.pcg64 import generate_state
from league.random.seeds import derive, derive_each, generator, generators

SEEDS = np.concatenate([np.arange(200), np.random.default_rng(0).integers(2**31, size=600), [2**31 - 1, 2**32 - 1]])


def with_numpy(draw: Callable[[np.random.Generator], Any]) -> np.ndarray:
    """What each seed's generator draws, (…, seeds)."""
    return np.stack([draw(np.random.default_rng(int(seed))) for seed in SEEDS], axis=-1)


@given(st.lists(st.integers(0, 2**32 - 1), max_size=9), st.integers(1, 9))
def test_outputs_of_a_seed_do_not_depend_on_the_others(seeds: list[int], count: int) -> None:
    expected = [np.random.PCG64(seed).random_raw(count) for seed in seeds]
    outputs = pcg64.outputs(np.array(seeds, dtype=np.int64), count)
    assert outputs.dtype == np.uint64
    assert outputs.shape == (count, len(seeds))
    assert outputs.T.tolist() == [array.tolist() for array in expected]


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


seeds = st.integers(0, 2**63 - 1)


paths = st.lists(st.integers(0, 2**31) | st.text(max_size=8), min_size=1, max_size=4)


@given(seeds, paths)
def test_a_seed_and_a_path_determine_a_seed(seed: int, path: list[int | str]) -> None:
    assert derive(seed, *path) == derive(seed, *path)
    assert 0 <= derive(seed, *path) < 2**63


def test_adjacent_seeds_and_paths_differ() -> None:
    children = {derive(seed, position) for seed in range(30) for position in range(30)}
    assert len(children) == 900
    assert generator(1, 2).integers(2**60) != generator(2, 1).integers(2**60)


def test_known_values_are_stable_for_old_ledgers() -> None:
    assert derive(0, 0) == 4334430513956379144
    assert derive(42, "game", 3) == 1465044601826300333


@given(seeds, st.lists(st.integers(0, 2**32 - 1), max_size=5))
def test_many_seeds_are_derived_at_once(seed: int, numbers: list[int]) -> None:
    assert derive_each(seed, numbers).tolist() == [derive(seed, number) for number in numbers]


@given(st.lists(st.tuples(seeds, st.integers(0, 2**31)), max_size=4), st.text(max_size=8))
def test_many_generators_are_created_at_once(rows: list[tuple[int, int]], name: str) -> None:
    row_seeds, numbers = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    expected = [generator(seed, name, number, 3).bit_generator.state for seed, number in rows]
    assert [rng.bit_generator.state for rng in generators(row_seeds, name, numbers, 3)] == expected


SEED = 1234567


EXPECTED = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821]
"""Of Vigna's splitmix64.c."""


def test_outputs_are_those_of_the_reference() -> None:
    seeds = np.array([[SEED], [0]], np.uint64)
    outputs = splitmix64.outputs(seeds, np.arange(5))
    assert outputs[0].tolist() == EXPECTED
    assert outputs[1, 0] == 0xE220A8397B1DCDAF


def test_integers_are_outputs_modulo_their_number() -> None:
    numbers = np.arange(2000)
    expected = [output % 240 for output in splitmix64.outputs(np.zeros(1, np.uint64), numbers).tolist()]
    assert splitmix64.integers(numbers, 240).tolist() == expected
    assert set(expected) == set(range(240))


def test_outputs_do_not_depend_on_the_others() -> None:
    numbers = np.array([4, 0, 2])
    assert splitmix64.outputs(np.full(3, SEED, np.uint64), numbers).tolist() == [EXPECTED[i] for i in (4, 0, 2)]
