"""Derives seeds and random generators from a recorded seed and a path."""

import zlib
from functools import lru_cache

import numpy as np


def derive(seed: int, *path: int | str) -> int:
    """Return a seed in [0, 2^63) that depends on `seed` and on each part of `path`.

    Uses NumPy's SeedSequence (O'Neill's seed_seq), whose outputs for different spawn keys are independent.
    """
    state = _sequence(seed, path).generate_state(1, np.uint64)[0]
    return int(state) >> 1


def generator(seed: int, *path: int | str) -> np.random.Generator:
    """Return the random generator of `path` below `seed`."""
    return np.random.Generator(np.random.PCG64(_sequence(seed, path)))


# The games of a block share their openings.
@lru_cache(maxsize=4096)
def _sequence(seed: int, path: tuple[int | str, ...]) -> np.random.SeedSequence:
    key = tuple(zlib.crc32(part.encode()) if isinstance(part, str) else part for part in path)
    return np.random.SeedSequence(seed, spawn_key=key)
