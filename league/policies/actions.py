"""Conversion between raw actions (samples of a distribution) and actions of an environment's space.

| action space                     | inputs of the distribution, (k, d) float32       | raw action                  |
|----------------------------------|--------------------------------------------------|-----------------------------|
| Discrete(n, start)               | n logits                                         | (k,) int64, from 0          |
| MultiDiscrete of m elements      | concatenated logits of the elements              | (k, m) int64, each from 0   |
| Box of floats with m elements    | m means, then m log standard deviations          | (k, m) float32, Gaussian    |

Discrete actions are the raw ones plus `start`. For a Box element with two finite bounds, raw values are clipped to
[-1, 1] and scaled to the bounds; for other elements they are clipped to the bounds that exist.
"""

import numpy as np
from numpy.typing import NDArray

from league.errors import ConfigError
from league.spaces import Box, Discrete, MultiDiscrete, Space
from league.spaces.arrays import bounds, mask_size


def dist_inputs_size(space: Space) -> int:
    """Return d, the number of distribution inputs. Raises ConfigError for an unsupported action space."""
    if (size := mask_size(space)) is not None:
        return size
    if isinstance(space, Box) and np.dtype(space.dtype).kind == "f":
        return 2 * int(np.prod(space.shape))
    raise ConfigError(f"unsupported action space {space!r}: expected Discrete, MultiDiscrete or a Box of floats")


def to_environment(raw: NDArray, space: Space) -> NDArray:
    """Convert raw actions to actions of the environment.

    Args:
        raw: Raw actions, (k,) or (k, m).
        space: The action space.

    Returns:
        Actions inside the space, (k, *shape), in its dtype.

    Raises:
        ConfigError: The action space is not supported.
    """
    match space:
        case Discrete(start=start, dtype=dtype):
            return (raw.astype(np.int64) + start).astype(dtype, copy=False)
        case MultiDiscrete(start=start, shape=shape, dtype=dtype):
            return (raw.reshape(-1, *shape) + np.asarray(start)).astype(dtype)
        case Box(shape=shape, dtype=dtype) if np.dtype(dtype).kind == "f":
            wide, (low, high) = raw.reshape(-1, *shape).astype(np.float64), bounds(space)
            largest = float(np.finfo(dtype).max)  # keeps unbounded values finite
            clipped = np.clip(wide, np.maximum(low, -largest), np.minimum(high, largest))
            finite = np.isfinite(low) & np.isfinite(high)
            if not finite.any():
                return clipped.astype(dtype)
            share = (np.clip(wide, -1, 1) + 1) / 2
            # A weighted mean of the bounds: `high - low` may overflow.
            spanned = np.where(finite, low, 0) * (1 - share) + np.where(finite, high, 0) * share
            return np.where(finite, np.clip(spanned, low, high), clipped).astype(dtype)
    raise ConfigError(f"unsupported action space {space!r}: expected Discrete, MultiDiscrete or a Box of floats")


def from_environment(actions: NDArray, space: Space) -> NDArray:
    """Convert actions of the environment to raw actions: the inverse of `to_environment`.

    Args:
        actions: (k, *shape), inside the space.
        space: The action space.

    Returns:
        Raw actions, (k,) or (k, m). Those of a Box element with two finite bounds are from -1 to 1.

    Raises:
        ConfigError: The action space is not supported.
    """
    match space:
        case Discrete(start=start):
            return actions.astype(np.int64) - start
        case MultiDiscrete(start=start):
            return (actions.astype(np.int64) - np.asarray(start)).reshape(len(actions), -1)
        case Box(dtype=dtype) if np.dtype(dtype).kind == "f":
            low, high = bounds(space)
            finite = np.isfinite(low) & np.isfinite(high) & (low < high)
            wide, low, high = actions.astype(np.float64), np.where(finite, low, -1), np.where(finite, high, 1)
            # Divided first: `high - low` may overflow.
            scaled = (wide / 2 - low / 4 - high / 4) / (high / 4 - low / 4)
            return np.where(finite, scaled, wide).astype(np.float32).reshape(len(actions), -1)
    raise ConfigError(f"unsupported action space {space!r}: expected Discrete, MultiDiscrete or a Box of floats")
