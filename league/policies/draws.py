"""Random choices of a batch: row i from generator i alone, so that it does not depend on the other rows."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from league.errors import InvalidInput

Generators = Sequence[np.random.Generator]


def draw(rng: Generators | None, rows: int, shape: tuple[int, ...] = ()) -> NDArray:
    """Uniform numbers in [0, 1), (rows, *shape) float64. Raises InvalidInput without a generator per row."""
    if rng is None or len(rng) != rows:
        given = "none" if rng is None else str(len(rng))
        raise InvalidInput(f"a random choice for {rows} rows needs rng, one generator per row: got {given}")
    if not shape:
        return np.array([generator.random() for generator in rng])
    return np.array([generator.random(shape) for generator in rng]).reshape(rows, *shape)


def choose(allowed: NDArray, rng: Generators | None) -> NDArray:
    """The index of a nonzero element of each row of `allowed` (k, n), each as likely; (k,) int64."""
    ranks = (allowed != 0).cumsum(axis=1)
    wanted = (draw(rng, len(allowed)) * ranks[:, -1]).astype(np.int64)
    return (ranks <= wanted[:, None]).sum(axis=1)


def sample(logits: NDArray, rng: Generators | None) -> NDArray:
    """One action of each row's categorical distribution with these logits (k, n); (k,) int64.

    By inversion: the first action at which the cumulated probability exceeds a uniform number.
    """
    weights = np.exp(logits - logits.max(axis=1, keepdims=True), dtype=np.float64)
    cumulated = weights.cumsum(axis=1)
    wanted = draw(rng, len(logits)) * cumulated[:, -1]
    return (cumulated <= wanted[:, None]).sum(axis=1)
