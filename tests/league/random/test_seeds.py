"""SplitMix64 has the outputs of its reference implementation."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from league.random import splitmix64
from league.random.seeds import derive, derive_each, generator, generators

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
    own, numbers = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    expected = [generator(seed, name, number, 3).bit_generator.state for seed, number in rows]
    assert [each.bit_generator.state for each in generators(own, name, numbers, 3)] == expected


SEED = 1234567


EXPECTED = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821]
"""Of Vigna's splitmix64.c."""


def test_outputs_are_those_of_the_reference() -> None:
    seeds = np.array([[SEED], [0]], np.uint64)
    found = splitmix64.outputs(seeds, np.arange(5))
    assert found[0].tolist() == EXPECTED
    assert found[1, 0] == 0xE220A8397B1DCDAF


def test_integers_are_outputs_modulo_their_number() -> None:
    numbers = np.arange(2000)
    expected = [output % 240 for output in splitmix64.outputs(np.zeros(1, np.uint64), numbers).tolist()]
    assert splitmix64.integers(numbers, 240).tolist() == expected
    assert set(expected) == set(range(240))


def test_outputs_do_not_depend_on_the_others() -> None:
    numbers = np.array([4, 0, 2])
    assert splitmix64.outputs(np.full(3, SEED, np.uint64), numbers).tolist() == [EXPECTED[i] for i in (4, 0, 2)]
