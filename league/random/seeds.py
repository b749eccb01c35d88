"""Derives seeds and random generators from a recorded seed and a path."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.random.bit_generator import ISeedSequence
from numpy.typing import NDArray

from league.random.pcg64 import generate_state
from policy_league_client.seeds import derive as derive
from policy_league_client.seeds import sequence
from policy_league_client.seeds import spawn_key as spawn_key


def derive_each(seed: int, numbers: Sequence[int]) -> NDArray[np.int64]:
    """Return `derive(seed, number)` for each number, (m,). seed: from 0 to 2⁶³ - 1."""
    words = np.asarray(numbers, dtype=np.int64)
    first = generate_state(np.full(len(words), seed), [words])[0]
    return (first >> np.uint64(1)).astype(np.int64)


def generator(seed: int, *path: int | str) -> np.random.Generator:
    """Return the random generator of `path` below `seed`."""
    return np.random.Generator(np.random.PCG64(sequence(seed, path)))


def generators(seeds: NDArray[np.int64], *path: int | str | NDArray[np.int64]) -> list[np.random.Generator]:
    """Return `generator(seed, *path)` for each of m seeds. Parts of the path may be arrays, (m,)."""
    states = np.ascontiguousarray(generate_state(seeds, spawn_key(*path)).T)
    # NumPy takes any ISeedSequence, its annotation only SeedSequence.
    return [np.random.Generator(np.random.PCG64(_Computed(state))) for state in states]  # type: ignore[arg-type]


class _Computed(ISeedSequence):
    """A seed sequence whose state is known."""

    def __init__(self, state: NDArray[np.uint64]) -> None:
        self._state = state

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> NDArray[np.uint64]:
        """Return the four words that PCG64 asks for."""
        assert (n_words, dtype) == (4, np.uint64)
        return self._state
