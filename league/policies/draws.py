"""Samples actions from the outputs of a policy graph, and computes action probabilities."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.errors import ConfigError, InvalidInput
from league.spaces import Box, Discrete, MultiDiscrete, Space
from league.spaces.arrays import bounds

Generators = Sequence[np.random.Generator]


class UniformNumbers(ABC):
    """A source of uniform numbers for k rows, which are drawn together."""

    @abstractmethod
    def draw(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return the next numbers in [0, 1), (k, *shape)."""


def draw(rng: Generators | UniformNumbers | None, rows: int, shape: tuple[int, ...] = ()) -> NDArray:
    """Return uniform numbers in [0, 1), (rows, *shape) float64. Raises InvalidInput unless each row has a generator."""
    if isinstance(rng, UniformNumbers):
        return rng.draw(shape)
    generators = _each(rng, rows)
    if not shape:
        return np.array([generator.random() for generator in generators])
    return np.array([generator.random(shape) for generator in generators]).reshape(rows, *shape)


def choose(allowed: NDArray, uniform: NDArray) -> NDArray:
    """Choose a random nonzero element of each row.

    Args:
        allowed: Mask, (k, n).
        uniform: Uniform numbers in [0, 1), (k,).

    Returns:
        Indices of the chosen elements, (k,) int64.
    """
    ranks = (allowed != 0).cumsum(axis=1)
    drawn_ranks = (uniform * ranks[:, -1]).astype(np.int64)
    return (ranks <= drawn_ranks[:, None]).sum(axis=1)


def invert(logits: NDArray, uniform: NDArray) -> NDArray:
    """Sample categorical distributions by inversion: the first action whose cumulative probability exceeds `uniform`.

    Args:
        logits: Logits, (k, n).
        uniform: Uniform numbers in [0, 1), (k,).

    Returns:
        Actions, (k,) int64.
    """
    weights = np.exp(logits - logits.max(axis=1, keepdims=True), dtype=np.float64)
    cumulated = weights.cumsum(axis=1)
    return (cumulated <= (uniform * cumulated[:, -1])[:, None]).sum(axis=1)


def normal(rng: Generators | UniformNumbers | None, rows: int, count: int) -> NDArray:
    """Return normally distributed numbers, (rows, count) float64. Raises InvalidInput like `draw`."""
    if isinstance(rng, UniformNumbers):
        radius, angle = np.split(rng.draw((2 * count,)), 2, axis=1)
        # Box and Muller (1958). A uniform number may be 0, but not 1.
        return np.sqrt(-2 * np.log1p(-radius)) * np.cos(2 * np.pi * angle)
    return np.array([generator.standard_normal(count) for generator in _each(rng, rows)]).reshape(rows, count)


def sample(dist_inputs: NDArray, space: Space, rng: Generators | UniformNumbers | None) -> NDArray:
    """Sample a raw action for each row; see `league.policies.actions`.

    Args:
        dist_inputs: Inputs of the distributions, (k, d) float32.
        space: The action space.
        rng: One generator per row, or uniform numbers of all rows.

    Returns:
        Raw actions, (k,) or (k, m).

    Raises:
        ConfigError: The action space is not supported.
        InvalidInput: There is not one generator per row.
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
            return (means + np.exp(log_deviations) * normal(rng, *means.shape)).astype(np.float32)
    raise ConfigError(f"unsupported action space {space!r}")


def elements(columns: NDArray, space: MultiDiscrete) -> list[NDArray]:
    """Split (k, sum of nvec) columns into one array (k, n) per element of the space."""
    stops = list(accumulate(np.ravel(space.nvec).tolist()))
    return np.split(columns, stops[:-1], axis=1)


def _each(rng: Generators | None, rows: int) -> Generators:
    if rng is None or len(rng) != rows:
        count = "none" if rng is None else str(len(rng))
        raise InvalidInput(f"a random choice for {rows} rows needs rng, one generator per row: got {count}")
    return rng


def probabilities(dist_inputs: NDArray, space: Space, mask: NDArray | None = None) -> list[Any]:
    """Compute the action distribution of each row as JSON values.

    Args:
        dist_inputs: Inputs of the distributions, (k, d).
        space: The action space.
        mask: Action mask, (k, n); masked actions have probability 0.

    Returns:
        One entry per row. Discrete: the probabilities of all actions, starting at `start`. MultiDiscrete: such a list
        per element. Box: `mean` and `std` in the shape and units of the space, before clipping to its bounds.

    Raises:
        ConfigError: The action space is not supported.
    """
    match space:
        case Discrete():
            return _shares(dist_inputs, mask).tolist()
        case MultiDiscrete():
            masks = [None] * int(np.size(space.nvec)) if mask is None else elements(mask, space)
            parts = [
                _shares(part, part_mask) for part, part_mask in zip(elements(dist_inputs, space), masks, strict=True)
            ]
            return [[part[row].tolist() for part in parts] for row in range(len(dist_inputs))]
        case Box(shape=shape):
            raw_means, log_deviations = np.split(dist_inputs.astype(np.float64), 2, axis=1)
            centre, half = _range(space)
            means, deviations = centre + raw_means * half, np.exp(log_deviations) * half
            pairs = zip(means.reshape(-1, *shape), deviations.reshape(-1, *shape), strict=True)
            return [{"mean": mean.tolist(), "std": deviation.tolist()} for mean, deviation in pairs]
    raise ConfigError(f"unsupported action space {space!r}")


def certain(actions: NDArray, space: Space) -> NDArray:
    """Compute inputs of distributions in which actions have the probability 1.

    Args:
        actions: Actions in the action space, (k, *shape).
        space: The action space.

    Returns:
        Inputs of the distributions, (k, d) float64.

    Raises:
        ConfigError: The action space is not supported.
    """
    match space:
        case Discrete(n=n, start=start):
            return _only(actions - start, n)
        case MultiDiscrete(nvec=nvec, start=start):
            raw = (actions - np.asarray(start)).reshape(len(actions), -1)
            parts = zip(raw.T, np.ravel(nvec).tolist(), strict=True)
            return np.concatenate([_only(choices, n) for choices, n in parts], axis=1)
        case Box():
            centre, half = _range(space)
            means = (actions.reshape(len(actions), -1) - centre) / np.where(half == 0, 1, half)
            return np.concatenate([means, np.full_like(means, -np.inf)], axis=1)
    raise ConfigError(f"unsupported action space {space!r}")


def _only(chosen: NDArray, n: int) -> NDArray:
    """Logits (k, n) with which one of n actions is certain. chosen: (k,)."""
    return np.where(np.arange(n) == chosen[:, np.newaxis], 0.0, -np.inf)


def _shares(logits: NDArray, mask: NDArray | None) -> NDArray:
    """Softmax, (k, n) float64."""
    if mask is not None:
        logits = np.where(mask != 0, logits, -np.inf)
    weights = np.exp(logits - logits.max(axis=1, keepdims=True), dtype=np.float64)
    return weights / weights.sum(axis=1, keepdims=True)


def _range(space: Box) -> tuple[NDArray, NDArray]:
    """Centre and half of the range, (m,), that raw values from -1 to 1 cover; of [-1, 1] without two finite bounds."""
    low, high = (np.ravel(bound) for bound in bounds(space))
    finite = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(finite, low, -1.0), np.where(finite, high, 1.0)
    return high / 2 + low / 2, high / 2 - low / 2
