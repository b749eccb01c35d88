"""Random choices of a batch: row i from generator i alone, so that it does not depend on the other rows."""

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from league.errors import ConfigError, InvalidInput
from league.spaces import Box, Discrete, MultiDiscrete, Space

Generators = Sequence[np.random.Generator]


def draw(rng: Generators | None, rows: int, shape: tuple[int, ...] = ()) -> NDArray:
    """Uniform numbers in [0, 1), (rows, *shape) float64. Raises InvalidInput without a generator per row."""
    generators = _each(rng, rows)
    if not shape:
        return np.array([generator.random() for generator in generators])
    return np.array([generator.random(shape) for generator in generators]).reshape(rows, *shape)


def choose(allowed: NDArray, uniform: NDArray) -> NDArray:
    """The index of a nonzero element of each row of `allowed` (k, n), each as likely; (k,) int64.

    uniform: (k,) numbers in [0, 1).
    """
    ranks = (allowed != 0).cumsum(axis=1)
    wanted = (uniform * ranks[:, -1]).astype(np.int64)
    return (ranks <= wanted[:, None]).sum(axis=1)


def invert(logits: NDArray, uniform: NDArray) -> NDArray:
    """One action of each row's categorical distribution with these logits (k, n); (k,) int64.

    The first action at which the cumulated probability exceeds the row's number of `uniform`, (k,) in [0, 1).
    """
    weights = np.exp(logits - logits.max(axis=1, keepdims=True), dtype=np.float64)
    cumulated = weights.cumsum(axis=1)
    return (cumulated <= (uniform * cumulated[:, -1])[:, None]).sum(axis=1)


def sample(dist_inputs: NDArray, space: Space, rng: Generators | None) -> NDArray:
    """A raw action of each row's distribution: see league/policies/actions.py.

    dist_inputs: (k, d) float32. Raises ConfigError for a space that has no distribution.
    """
    rows = len(dist_inputs)
    match space:
        case Discrete():
            return invert(dist_inputs, draw(rng, rows))
        case MultiDiscrete():
            parts = elements(dist_inputs, space)
            uniform = draw(rng, rows, (len(parts),))
            return np.stack([invert(part, uniform[:, i]) for i, part in enumerate(parts)], axis=1)
        case Box():
            means, log_deviations = np.split(dist_inputs, 2, axis=1)
            noise = np.array([generator.standard_normal(means.shape[1]) for generator in _each(rng, rows)])
            return (means + np.exp(log_deviations) * noise.reshape(means.shape)).astype(np.float32)
    raise ConfigError(f"no policy has actions of {space!r}")


def elements(columns: NDArray, space: MultiDiscrete) -> list[NDArray]:
    """Columns (k, sum of nvec), one for each value of each element, divided by element: (k, n) each."""
    stops = list(accumulate(np.ravel(space.nvec).tolist()))
    return np.split(columns, stops[:-1], axis=1)


def _each(rng: Generators | None, rows: int) -> Generators:
    if rng is None or len(rng) != rows:
        given = "none" if rng is None else str(len(rng))
        raise InvalidInput(f"a random choice for {rows} rows needs rng, one generator per row: got {given}")
    return rng
