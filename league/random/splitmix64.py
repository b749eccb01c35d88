"""SplitMix64 for many seeds at once (Steele, Lea and Flood, 2014, "Fast splittable pseudorandom number generators").

Output n is a function of the seed and n, so that no state is kept, and each number takes a few operations only.
"""

import numpy as np
from numpy.typing import NDArray

GAMMA = np.uint64(0x9E3779B97F4A7C15)
"""2⁶⁴ divided by the golden ratio, made odd: the difference between two states."""
FACTORS = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
"""Factors of the finaliser: variant 13 of Stafford's mixers."""


def outputs(seeds: NDArray[np.uint64], numbers: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return output `number`, from 0, of the generator with each seed. The shapes are broadcast."""
    mixed = seeds + (numbers.astype(np.uint64) + np.uint64(1)) * GAMMA
    mixed = (mixed ^ (mixed >> np.uint64(30))) * FACTORS[0]
    mixed = (mixed ^ (mixed >> np.uint64(27))) * FACTORS[1]
    return mixed ^ (mixed >> np.uint64(31))


def integers(numbers: NDArray[np.int64], high: int) -> NDArray[np.int64]:
    """Return integers from 0 to `high` - 1, one for each number: that output of the generator with seed 0, modulo
    `high`.

    Of the 2⁶⁴ outputs, ⌊2⁶⁴ / high⌋ or one more give each integer: no probability is further than 2⁻⁶⁴ from 1 / high.
    """
    return (outputs(np.zeros(1, np.uint64), numbers) % np.uint64(high)).astype(np.int64)
