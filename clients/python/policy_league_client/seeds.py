"""Derives seeds from a recorded seed and a path."""

import zlib
from functools import lru_cache
from typing import Any

import numpy as np


def derive(seed: int, *path: int | str) -> int:
    """Return a seed in [0, 2^63) that depends on `seed` and on each part of `path`.

    Uses NumPy's SeedSequence (O'Neill's seed_seq), whose outputs for different spawn keys are independent.
    """
    state = sequence(seed, path).generate_state(1, np.uint64)[0]
    return int(state) >> 1


# The seed of a match is derived several times.
@lru_cache(maxsize=4096)
def sequence(seed: int, path: tuple[int | str, ...]) -> np.random.SeedSequence:
    """Return NumPy's seed sequence of a path below `seed`."""
    return np.random.SeedSequence(seed, spawn_key=spawn_key(*path))


def spawn_key(*path: Any) -> list[Any]:
    """Return the numbers that stand for a path in NumPy's SeedSequence. Parts may be arrays."""
    return [zlib.crc32(part.encode()) if isinstance(part, str) else part for part in path]
