"""SplitMix64 has the outputs of its reference implementation."""

import numpy as np

from league.random import splitmix64

SEED = 1234567
EXPECTED = [
    6457827717110365317,
    3203168211198807973,
    9817491932198370423,
    4593380528125082431,
    16408922859458223821,
]
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
