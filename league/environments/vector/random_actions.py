"""Random legal actions for many agents at once."""

import numpy as np
from numpy.typing import NDArray

from league.spaces import Box, Discrete, MultiBinary, MultiDiscrete, Space

AT_A_BOUND = 0.1
"""Share of the elements of a bounded Box that are drawn at a bound."""


def random_actions(space: Space, count: int, mask: NDArray | None, rng: np.random.Generator) -> NDArray:
    """Draw `count` actions from `space`, (count, …). mask: (count, n), or None if all actions are legal."""
    match space:
        case Discrete():
            if mask is None:
                return rng.integers(space.start, space.start + space.n, size=count)
            return space.start + random_choices(mask, rng)
        case MultiDiscrete():
            choices = np.asarray(space.nvec).ravel()
            allowed = np.ones((count, choices.sum()), dtype=np.int8) if mask is None else mask
            parts = np.split(allowed, np.cumsum(choices)[:-1], axis=1)
            chosen = np.stack([random_choices(part, rng) for part in parts], axis=1)
            return (np.asarray(space.start) + chosen.reshape(count, *space.shape)).astype(space.dtype)
        case MultiBinary():
            return rng.integers(2, size=(count, *space.shape)).astype(space.dtype)
        case Box():
            return _in_box(space, count, rng)
    raise TypeError(f"random actions of a {type(space).__name__} are not supported")


def random_choices(mask: NDArray, rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose one of the nonzero columns of each row, all with the same probability, (k,). mask: (k, n)."""
    allowed = np.cumsum(mask != 0, axis=1, dtype=np.int32)
    choice = (rng.random(len(mask)) * allowed[:, -1]).astype(np.int32)
    return (allowed > choice[:, np.newaxis]).argmax(axis=1)


def _in_box(space: Box, count: int, rng: np.random.Generator) -> NDArray:
    low, high = (np.broadcast_to(np.array(bound, dtype=np.float64), space.shape) for bound in (space.low, space.high))
    unbounded = ~(np.isfinite(low) & np.isfinite(high))
    drawn = rng.uniform(np.where(unbounded, 0, low), np.where(unbounded, 0, high), (count, *space.shape))
    at_bound = np.where(rng.random(drawn.shape) < 0.5, low, high)
    drawn = np.where(rng.random(drawn.shape) < AT_A_BOUND, at_bound, drawn)
    drawn = np.where(unbounded, rng.normal(size=drawn.shape), drawn)
    return drawn.astype(space.dtype)
