"""Arrays of a space's leaves: those of an environment's observation, and the validation of requests."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.errors import IllegalMask, ObservationError
from league.spaces import Box, Discrete, Leaf, MultiBinary, MultiDiscrete, Space, leaf_paths, paths


def tensors(space: Space, value: Any) -> dict[str, NDArray]:
    """Split an environment's observation into one array per ONNX input, without copying if possible."""
    return {name: np.asarray(at_path(value, path), dtype=leaf.dtype) for name, path, leaf in leaf_paths(space)}


def nested(space: Space, arrays: Mapping[str, Any]) -> Any:
    """Return what `tensors` splits: values by ONNX input, in the structure of `space`."""
    value: Any = {}
    for name, path in paths(space).items():
        if not path:
            return arrays[name]
        part = value
        for key in path[:-1]:
            part = part.setdefault(key, {})
        part[path[-1]] = arrays[name]
    return value


def check(name: str, array: NDArray, leaf: Leaf) -> NDArray:
    """Return a batch (k, *leaf.shape) in the dtype of `leaf`, or raise ObservationError.

    Integers are accepted for floats and integral floats for integers, because JSON does not distinguish them. Values
    must be finite and fit the dtype. The bounds of a Box are not enforced, because environments violate them.
    """
    if array.shape[1:] != leaf.shape:
        raise ObservationError(f"{name} has shape {_text(array.shape[1:])}, expected {_text(leaf.shape)}")
    dtype = np.dtype(leaf.dtype)
    if array.dtype != dtype:
        array = _cast(name, array, dtype)
    if dtype.kind == "f" and not np.isfinite(array).all():
        raise ObservationError(f"{name} contains NaN or infinity, expected finite {dtype.name}")
    match leaf:
        case Discrete(n=n, start=start):
            _within(name, array, start, start + n - 1)
        case MultiDiscrete(nvec=nvec, start=start):
            _within(name, array, np.asarray(start), np.asarray(start) + np.asarray(nvec) - 1)
        case MultiBinary():
            _within(name, array, 0, 1)
    return array


def check_mask(mask: NDArray) -> None:
    """Raise IllegalMask unless each row of a mask (k, n) contains only 0 and 1, and at least one 1."""
    if len(mask) == 1 and mask.itemsize == 1:
        row = mask.tobytes()
        if b"\1" in row and not row.strip(b"\0\1"):  # fast path for the common case, ten times cheaper
            return
    if ((mask != 0) & (mask != 1)).any():
        raise IllegalMask("action_mask contains values other than 0 and 1")
    check_legal_action(mask)


def check_legal_action(mask: NDArray) -> None:
    """Raise IllegalMask unless each row of a mask (k, n) allows an action."""
    if not mask.any(axis=-1).all():
        raise IllegalMask("action_mask allows no action: expected at least one 1")


def mask_size(action: Space) -> int | None:
    """Return the size of the mask of an action space; None if its actions cannot be masked."""
    match action:
        case Discrete(n=n):
            return n
        case MultiDiscrete(nvec=nvec):
            return int(np.sum(nvec))
    return None


def bounds(space: Box) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return lower and upper bounds, (*shape) float64; infinite if missing."""
    # None becomes NaN in a float array; bounds contain no other NaN.
    low, high = (np.array(bound, dtype=np.float64) for bound in (space.low, space.high))
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    return np.broadcast_to(low, space.shape), np.broadcast_to(high, space.shape)


def environment_actions(actions: NDArray, space: Space) -> list[Any]:
    """Return actions (k, …) one by one, as `sample` of Gymnasium's space returns them."""
    if isinstance(space, Discrete):
        return list(actions.astype(space.dtype, copy=False))
    # An array also if the shape is (): `list` would return NumPy's scalars.
    return [actions[row, ...] for row in range(len(actions))]


def at_path(value: Any, path: tuple[str, ...]) -> Any:
    """Return the part of nested dicts at a path of keys."""
    for key in path:
        value = value[key]
    return value


def _cast(name: str, array: NDArray, dtype: np.dtype[Any]) -> NDArray:
    if array.dtype.kind not in "iufb":
        raise ObservationError(f"{name} contains values other than numbers, expected {dtype.name}")
    if dtype.kind == "f":
        with np.errstate(over="ignore"):  # overflow becomes infinity, which is rejected below
            return array.astype(dtype)
    if array.dtype.kind != "f":
        cast = array.astype(dtype)
        if (cast == array).all():  # fast path for the common case, three times cheaper than two bounds
            return cast
    elif not (np.isfinite(array).all() and (array == np.floor(array)).all()):
        raise ObservationError(f"{name} contains fractions, NaN or infinity, expected {dtype.name}")
    if dtype.kind == "b":
        low, high = 0, 1
    else:
        low, high = int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)
    _within(name, array, low, high)
    return array.astype(dtype)


def _within(name: str, array: NDArray, low: Any, high: Any) -> None:
    if array.size and ((array < low).any() or (array > high).any()):
        raise ObservationError(f"{name} must be between {_value(low)} and {_value(high)}")


def _text(shape: tuple[int, ...]) -> str:
    return str(list(shape))


def _value(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value
