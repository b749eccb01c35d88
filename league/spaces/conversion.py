"""Conversion of spaces from and to Gymnasium's."""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from league.errors import EnvironmentMismatch
from league.spaces import ACTION_MASK, Box, DictSpace, Discrete, MultiBinary, MultiDiscrete, Space, leaf_paths
from league.spaces.arrays import mask_size

MAX_CHOICES = 2**16
"""Choices of a Discrete, or of all elements of a MultiDiscrete. Each is an input or an output of a network."""


def from_gymnasium(space: gymnasium.Space[Any]) -> Space:
    """Convert a Gymnasium space. Raises EnvironmentMismatch for unsupported kinds (Text, Graph, …), and without values
    or with too many choices.
    """
    converted: Space
    match space:
        case gymnasium.spaces.Box():
            converted = Box(dtype=space.dtype.name, shape=space.shape, low=_bound(space.low), high=_bound(space.high))
        case gymnasium.spaces.Discrete():
            converted = Discrete(n=int(space.n), start=int(space.start), dtype=np.dtype(space.dtype).name)
        case gymnasium.spaces.MultiDiscrete():
            nvec, start, dtype = space.nvec.tolist(), space.start.tolist(), np.dtype(space.dtype).name
            converted = MultiDiscrete(nvec=nvec, start=start, shape=space.shape, dtype=dtype)
        case gymnasium.spaces.MultiBinary():
            converted = MultiBinary(shape=space.shape)
        case gymnasium.spaces.Dict():
            return _dict_from_gymnasium(space)
        case _:
            raise EnvironmentMismatch(
                f"space {space} is not supported: expected Box, Discrete, MultiDiscrete, MultiBinary or Dict"
            )
    if 0 in converted.shape:
        raise EnvironmentMismatch(f"space {space} has no elements: expected at least one")
    if (choices := mask_size(converted) or 0) > MAX_CHOICES:
        raise EnvironmentMismatch(f"space {space} has {choices:,} choices: expected at most {MAX_CHOICES:,}")
    return converted


def _dict_from_gymnasium(space: gymnasium.spaces.Dict) -> DictSpace:
    """Convert a Dict, whose leaves must have different names."""
    if not_text := [key for key in space.spaces if not isinstance(key, str)]:
        raise EnvironmentMismatch(f"a Dict has the key {not_text[0]!r}: expected a string")
    if not space.spaces:
        raise EnvironmentMismatch("a Dict without keys is not supported: remove it")
    converted = DictSpace(spaces={key: from_gymnasium(part) for key, part in space.spaces.items()})
    names = [name for name, *_ in leaf_paths(converted)]
    if len(set(names)) < len(names):
        name = next(name for name in names if names.count(name) > 1)
        raise EnvironmentMismatch(f"two parts of an observation would have the name {name!r}: rename a key")
    return converted


def with_mask(observation: Space, action: Space) -> Space:
    """Return the observation space of an agent with these actions.

    A key `action_mask` is the action mask; of actions that cannot be masked it is an observation like any other.
    Raises EnvironmentMismatch if it does not fit the actions.
    """
    if not (isinstance(observation, DictSpace) and ACTION_MASK in observation.spaces):
        return observation
    size, mask = mask_size(action), observation.spaces[ACTION_MASK]
    if size is None:
        return observation.model_copy(update={"maskable": False})
    if isinstance(mask, DictSpace) or mask.shape != (size,):
        form = "is a Dict" if isinstance(mask, DictSpace) else f"has the shape {list(mask.shape)}"
        per = "action" if isinstance(action, Discrete) else "choice of each element, element by element"
        raise EnvironmentMismatch(f"action_mask {form}, expected [{size}]: one number for each {per}")
    if len(observation.spaces) == 1:
        raise EnvironmentMismatch("observations contain only action_mask: expected at least one more key")
    return observation


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
            return gymnasium.spaces.Discrete(space.n, start=space.start, dtype=np.dtype(space.dtype).type)
        case MultiDiscrete():
            dtype = np.dtype(space.dtype).type
            return gymnasium.spaces.MultiDiscrete(space.nvec, dtype=dtype, start=space.start)
        case MultiBinary():
            return gymnasium.spaces.MultiBinary(space.shape if len(space.shape) > 1 else space.shape[0])
        case DictSpace():
            return gymnasium.spaces.Dict({key: to_gymnasium(part) for key, part in space.spaces.items()})


def _bound(bound: NDArray) -> Any:
    """One number if all elements have it, else nested lists; None in place of an infinite one."""
    finite = np.where(np.isfinite(bound), bound, np.array(None))
    return finite.flat[0] if bound.size and (bound == bound.flat[0]).all() else finite.tolist()


def _unbound(bound: Any, infinity: float, space: Box) -> NDArray:
    # None, an infinite bound, becomes NaN in a float array; bounds contain no other NaN.
    finite = np.array(bound, dtype=np.float64)
    exact = np.array(bound, dtype=space.dtype) if not np.isnan(finite).any() else np.nan_to_num(finite, nan=infinity)
    return np.broadcast_to(exact, space.shape).astype(space.dtype)
