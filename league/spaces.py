"""Spaces as plain data: what a manifest records, and what a request is checked against.

A value of a space travels as one array per leaf, under the name of the ONNX input that takes it:

| space                                              | names                                       |
|----------------------------------------------------|---------------------------------------------|
| a leaf (Box, Discrete, MultiDiscrete, MultiBinary) | `observation`                               |
| Dict with `observation` and `action_mask`          | `observation` (or its leaves), `action_mask` |
| any other Dict                                     | `observation.<key>`, nested keys dotted     |

Gymnasium is imported by the two conversions only: a serving replica does without it.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from league.errors import EnvironmentMismatch, IllegalMask, ObservationError

if TYPE_CHECKING:
    import gymnasium

OBSERVATION = "observation"
ACTION_MASK = "action_mask"


class _Space(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Box(_Space):
    """An array of numbers. A bound is one number where all elements share it, else nested lists; None is infinite."""

    type: Literal["box"] = "box"
    dtype: str
    shape: tuple[int, ...]
    low: Any
    high: Any


class Discrete(_Space):
    """One of n integers from `start` on."""

    type: Literal["discrete"] = "discrete"
    n: int
    start: int = 0
    dtype: str = "int64"

    @property
    def shape(self) -> tuple[int, ...]:
        return ()


class MultiDiscrete(_Space):
    """An array of integers, element i in [start_i, start_i + nvec_i)."""

    type: Literal["multi_discrete"] = "multi_discrete"
    nvec: Any
    start: Any
    shape: tuple[int, ...]
    dtype: str = "int64"


class MultiBinary(_Space):
    """An array of 0 and 1."""

    type: Literal["multi_binary"] = "multi_binary"
    shape: tuple[int, ...]
    dtype: str = "int8"


class DictSpace(_Space):
    """Named spaces."""

    type: Literal["dict"] = "dict"
    spaces: dict[str, "Space"]


Leaf = Box | Discrete | MultiDiscrete | MultiBinary
Space = Annotated[Box | Discrete | MultiDiscrete | MultiBinary | DictSpace, Field(discriminator="type")]


def from_gymnasium(space: "gymnasium.Space[Any]") -> Space:
    """Describe a Gymnasium space. Raises EnvironmentMismatch for kinds that no policy can take (Text, Graph, …)."""
    import gymnasium

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


def to_gymnasium(space: Space) -> "gymnasium.Space[Any]":
    """The Gymnasium space that `space` describes."""
    import gymnasium

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


def inputs(space: Space) -> dict[str, Leaf]:
    """ONNX input name → leaf, in the order in which a graph takes them."""
    return dict(_leaves(space))


def paths(space: Space) -> dict[str, tuple[str, ...]]:
    """ONNX input name → the keys that lead to its leaf in a value of `space`, in the order of `inputs`."""
    if not isinstance(space, DictSpace):
        return {OBSERVATION: ()}
    return {name: path for name, path, _ in _paths(space)}


def tensors(space: Space, value: Any) -> dict[str, NDArray]:
    """Split one value of `space`, as an environment gives it, into its arrays, without a copy where none is needed."""
    if not isinstance(space, DictSpace):
        return {OBSERVATION: np.asarray(value, dtype=space.dtype)}
    return {name: np.asarray(_at(value, path), dtype=dtype) for name, path, dtype in _paths(space)}


def check(name: str, array: NDArray, leaf: Leaf) -> NDArray:
    """Return a batch `array` (k, *leaf.shape) in the dtype of `leaf`, or raise ObservationError.

    Integers are taken for floats and whole floats for integers, as JSON does not tell them apart. Values must be
    finite and fit the dtype; the bounds of a Box are not enforced, since environments do not keep to them either.
    """
    if array.shape[1:] != leaf.shape:
        raise ObservationError(f"{name} has shape {_text(array.shape[1:])}, expected {_text(leaf.shape)}")
    dtype = np.dtype(leaf.dtype)
    if array.dtype != dtype:
        array = _cast(name, array, dtype)
    if dtype.kind == "f" and not np.isfinite(array).all():
        raise ObservationError(f"{name} holds NaN or infinity, expected finite {dtype.name}")
    match leaf:
        case Discrete(n=n, start=start):
            _within(name, array, start, start + n - 1)
        case MultiDiscrete(nvec=nvec, start=start):
            _within(name, array, np.asarray(start), np.asarray(start) + np.asarray(nvec) - 1)
        case MultiBinary():
            _within(name, array, 0, 1)
    return array


def check_mask(mask: NDArray) -> None:
    """Raise IllegalMask unless each row of `mask` (k, n) holds only 0 and 1, and at least one 1."""
    if len(mask) == 1 and mask.itemsize == 1:
        row = mask.tobytes()
        if b"\1" in row and not row.strip(b"\0\1"):  # the common case, at a tenth of the cost
            return
    if ((mask != 0) & (mask != 1)).any():
        raise IllegalMask("action_mask holds something other than 0 and 1")
    if not mask.any(axis=-1).all():
        raise IllegalMask("action_mask allows no action: expected at least one 1")


def _leaves(space: Space) -> Iterator[tuple[str, Leaf]]:
    if not isinstance(space, DictSpace):
        yield OBSERVATION, space
        return
    for name, path, _ in _paths(space):
        leaf: Space = space
        for key in path:
            assert isinstance(leaf, DictSpace)
            leaf = leaf.spaces[key]
        assert not isinstance(leaf, DictSpace)
        yield name, leaf


def _paths(space: DictSpace) -> list[tuple[str, tuple[str, ...], str]]:
    masked = OBSERVATION in space.spaces and ACTION_MASK in space.spaces
    if not masked:
        return list(_walk(OBSERVATION, (), space))
    paths = list(_walk(OBSERVATION, (OBSERVATION,), space.spaces[OBSERVATION]))
    return [*paths, *_walk(ACTION_MASK, (ACTION_MASK,), space.spaces[ACTION_MASK])]


def _walk(name: str, path: tuple[str, ...], space: Space) -> Iterator[tuple[str, tuple[str, ...], str]]:
    if isinstance(space, DictSpace):
        for key, part in space.spaces.items():
            yield from _walk(f"{name}.{key}", (*path, key), part)
    else:
        yield name, path, space.dtype


def _at(value: Any, path: tuple[str, ...]) -> Any:
    for key in path:
        value = value[key]
    return value


def _cast(name: str, array: NDArray, dtype: np.dtype[Any]) -> NDArray:
    if array.dtype.kind not in "iufb":
        raise ObservationError(f"{name} holds something other than numbers, expected {dtype.name}")
    if dtype.kind == "f":
        with np.errstate(over="ignore"):  # what overflows becomes infinite, and is refused as such
            return array.astype(dtype)
    if array.dtype.kind != "f":
        cast = array.astype(dtype)
        if (cast == array).all():  # the common case, at a third of the cost of two bounds
            return cast
    elif not (np.isfinite(array).all() and (array == np.floor(array)).all()):
        raise ObservationError(f"{name} holds fractions, NaN or infinity, expected {dtype.name}")
    if dtype.kind == "b":
        low, high = 0, 1
    else:
        low, high = int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)
    _within(name, array, low, high)
    return array.astype(dtype)


def _within(name: str, array: NDArray, low: Any, high: Any) -> None:
    if array.size and ((array < low).any() or (array > high).any()):
        raise ObservationError(f"{name} must be between {_value(low)} and {_value(high)}")


def _bound(bound: NDArray) -> Any:
    if bound.size and (bound == bound.flat[0]).all():
        return _finite(bound.flat[0].item())
    return _nested(bound.tolist())


def _unbound(bound: Any, infinity: float, space: Box) -> NDArray:
    # None, which stands for an infinite bound, becomes NaN in an array of floats; there is no other NaN among bounds.
    finite = np.array(bound, dtype=np.float64)
    exact = np.array(bound, dtype=space.dtype) if not np.isnan(finite).any() else np.nan_to_num(finite, nan=infinity)
    return np.broadcast_to(exact, space.shape).astype(space.dtype)


def _nested(values: Any) -> Any:
    return [_nested(value) for value in values] if isinstance(values, list) else _finite(values)


def _finite(value: Any) -> Any:
    return value if np.isfinite(value) else None


def _text(shape: tuple[int, ...]) -> str:
    return str(list(shape))


def _value(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value
