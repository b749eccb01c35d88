"""Raw actions, as a learner draws them, ↔ actions of the environment's own space.

| action space                     | inputs of the distribution, (k, d) float32       | raw action                  |
|----------------------------------|--------------------------------------------------|-----------------------------|
| Discrete(n, start)               | n logits                                         | (k,) int64, from 0          |
| MultiDiscrete of m elements      | the logits of its elements one behind another    | (k, m) int64, each from 0   |
| Box of floats with m elements    | m means, then m logarithms of the deviations     | (k, m) float32, a Gaussian  |

The environment's action is the raw one plus `start`, and for a Box element by element: where both bounds are finite,
raw values in [-1, 1] span them and others are clipped; elsewhere raw values are clipped to what bounds there are.
"""

import numpy as np
from numpy.typing import NDArray

from league.errors import ConfigError
from league.spaces import Box, Discrete, MultiDiscrete, Space


def dist_inputs_size(space: Space) -> int:
    """d. Raises ConfigError for an action space that no policy can have."""
    match space:
        case Discrete(n=n):
            return n
        case MultiDiscrete(nvec=nvec):
            return int(np.sum(nvec))
        case Box(dtype=dtype, shape=shape) if np.dtype(dtype).kind == "f":
            return 2 * int(np.prod(shape))
    raise ConfigError(f"no policy has actions of {space!r}: expected Discrete, MultiDiscrete or a Box of floats")


def to_environment(raw: NDArray, space: Space) -> NDArray:
    """(k,) or (k, m) raw actions → (k, *shape) actions in the dtype of `space`, and inside it.

    Raises ConfigError for an action space that no policy can have.
    """
    match space:
        case Discrete(start=start):
            return raw.astype(np.int64) + start
        case MultiDiscrete(start=start, shape=shape, dtype=dtype):
            return (raw.reshape(-1, *shape) + np.asarray(start)).astype(dtype)
        case Box(shape=shape, dtype=dtype) if np.dtype(dtype).kind == "f":
            wide, largest = raw.reshape(-1, *shape).astype(np.float64), float(np.finfo(dtype).max)
            return _spanned(wide, *bounds(space), largest).astype(dtype)
    raise ConfigError(f"no policy has actions of {space!r}: expected Discrete, MultiDiscrete or a Box of floats")


def bounds(space: Box) -> tuple[NDArray, NDArray]:
    """Lowest and highest values, (*shape) float64; infinite where there is no bound."""
    return _bound(space.low, -np.inf, space.shape), _bound(space.high, np.inf, space.shape)


def _spanned(raw: NDArray, low: NDArray, high: NDArray, largest: float) -> NDArray:
    """largest: what the dtype holds, so that an absent bound does not let a finite number become infinite."""
    clipped = np.clip(raw, np.maximum(low, -largest), np.minimum(high, largest))
    finite = np.isfinite(low) & np.isfinite(high)
    if not finite.any():
        return clipped
    share = (np.clip(raw, -1, 1) + 1) / 2
    # Weighted bounds, not the lower one plus a share of the span, which may overflow.
    spanned = np.where(finite, low, 0) * (1 - share) + np.where(finite, high, 0) * share
    return np.where(finite, np.clip(spanned, low, high), clipped)


def _bound(bound: object, infinity: float, shape: tuple[int, ...]) -> NDArray:
    # None becomes NaN in an array of floats; there is no other NaN among bounds.
    values = np.array(bound, dtype=np.float64)
    return np.broadcast_to(np.where(np.isnan(values), infinity, values), shape)
