"""Conversion of spaces from and to Gymnasium's."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from league.errors import EnvironmentMismatch
from league.spaces import Box, DictSpace, Discrete, MultiBinary, MultiDiscrete, Space


def from_gymnasium(space: gymnasium.Space[Any]) -> Space:
    """Convert a Gymnasium space. Raises EnvironmentMismatch for unsupported kinds (Text, Graph, …)."""
    match space:
        case gymnasium.spaces.Box():
            return Box(dtype=space.dtype.name, shape=space.shape, low=_bound(space.low), high=_bound(space.high))
        case gymnasium.spaces.Discrete():
            return Discrete(n=int(space.n), start=int(space.start))
        case gymnasium.spaces.MultiDiscrete():
            return MultiDiscrete(
                nvec=space.nvec.tolist(),
                start=space.start.tolist(),
                shape=space.shape,
                dtype=np.dtype(space.dtype).name,
            )
        case gymnasium.spaces.MultiBinary():
            return MultiBinary(shape=space.shape)
        case gymnasium.spaces.Dict():
            return DictSpace(spaces={key: from_gymnasium(part) for key, part in space.spaces.items()})
    raise EnvironmentMismatch(
        f"space {space} is not supported: expected Box, Discrete, MultiDiscrete, MultiBinary or Dict"
    )


def to_gymnasium(space: Space) -> gymnasium.Space[Any]:
    """Convert to a Gymnasium space."""
    match space:
        case Box():
            return gymnasium.spaces.Box(
                low=_unbound(space.low, -np.inf, space),
                high=_unbound(space.high, np.inf, space),
                dtype=np.dtype(space.dtype).type,
            )
        case Discrete():
            return gymnasium.spaces.Discrete(space.n, start=space.start)
        case MultiDiscrete():
            dtype = np.dtype(space.dtype).type
            return gymnasium.spaces.MultiDiscrete(space.nvec, dtype=dtype, start=space.start)
        case MultiBinary():
            return gymnasium.spaces.MultiBinary(space.shape if len(space.shape) > 1 else space.shape[0])
        case DictSpace():
            return gymnasium.spaces.Dict({key: to_gymnasium(part) for key, part in space.spaces.items()})


def _bound(bound: NDArray) -> Any:
    if bound.size and (bound == bound.flat[0]).all():
        return _finite(bound.flat[0].item())
    return _nested(bound.tolist())


def _unbound(bound: Any, infinity: float, space: Box) -> NDArray:
    # None, an infinite bound, becomes NaN in a float array; bounds contain no other NaN.
    finite = np.array(bound, dtype=np.float64)
    exact = np.array(bound, dtype=space.dtype) if not np.isnan(finite).any() else np.nan_to_num(finite, nan=infinity)
    return np.broadcast_to(exact, space.shape).astype(space.dtype)


def _nested(values: Any) -> Any:
    return [_nested(value) for value in values] if isinstance(values, list) else _finite(values)


def _finite(value: Any) -> Any:
    return value if np.isfinite(value) else None
