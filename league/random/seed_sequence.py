"""NumPy's SeedSequence for many seeds at once.

`numpy.random.SeedSequence(seed)` takes several microseconds for each seed. This module computes the same state by
operations on arrays of seeds. NumPy guarantees that the algorithm does not change.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray


def generate_state(seeds: NDArray[np.int64], spawn_key: Sequence[int | NDArray[np.int64]] = ()) -> NDArray[np.uint64]:
    """Return `SeedSequence(seed, spawn_key=spawn_key).generate_state(4, numpy.uint64)` for each seed.

    Args:
        seeds: Seeds from 0 to 2⁶³ - 1, (m,).
        spawn_key: Numbers from 0 to 2³² - 1, each the same for all seeds or an array (m,).

    Returns:
        (4, m) uint64.
    """
    pool = np.zeros((4, len(seeds)), dtype=np.uint32)
    pool[0], pool[1] = seeds & 0xFFFFFFFF, seeds >> 32
    constants = _powers(0x43B0D7E5, 0x931E8875, 17 + 4 * len(spawn_key))
    pool = _hashed(pool, constants[:5])
    for source in range(4):
        other_rows = [row for row in range(4) if row != source]
        first = 4 + 3 * source
        pool[other_rows] = _mixed(pool[other_rows], _hashed(pool[source], constants[first : first + 4]))
    for number, word in enumerate(spawn_key):
        first = 16 + 4 * number
        pool = _mixed(pool, _hashed(np.asarray(word).astype(np.uint32), constants[first : first + 5]))
    words = _hashed(np.concatenate([pool, pool]), _powers(0x8B51F9DD, 0x58F38DED, 9)).astype(np.uint64)
    return words[0::2] | (words[1::2] << np.uint64(32))


def _hashed(values: NDArray[np.uint32], constants: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """SeedSequence's `hashmix`. Each value uses a constant and the next one."""
    values = (values ^ constants[:-1]) * constants[1:]
    return values ^ (values >> np.uint32(16))


def _mixed(x: NDArray[np.uint32], y: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """SeedSequence's `mix`."""
    mixed = x * np.uint32(0xCA01F9DD) - y * np.uint32(0x4973F715)
    return mixed ^ (mixed >> np.uint32(16))


@cache
def _powers(first: int, factor: int, count: int) -> NDArray[np.uint32]:
    """Return first · factorⁱ mod 2³², (count, 1)."""
    return np.array([[first * pow(factor, i, 2**32) % 2**32] for i in range(count)], dtype=np.uint32)
