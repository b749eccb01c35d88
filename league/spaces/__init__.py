"""Serialisable spaces, for manifests and for the validation of requests.

A value of a space is represented by one array per leaf, named after the ONNX input:

| space                                              | names                                       |
|----------------------------------------------------|---------------------------------------------|
| a leaf (Box, Discrete, MultiDiscrete, MultiBinary) | `observation`                               |
| Dict with `observation` and `action_mask`          | `observation` (or its leaves), `action_mask` |
| any other Dict                                     | `observation.<key>`, nested keys dotted     |

Arrays are in arrays.py and conversions in conversion.py, because the command line reads manifests without NumPy, and a
serving replica handles arrays without Gymnasium.
"""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

OBSERVATION = "observation"
ACTION_MASK = "action_mask"


class _Space(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Box(_Space):
    """An array of numbers. A bound is a number if all elements share it, else nested lists; None means infinite."""

    type: Literal["box"] = "box"
    dtype: str
    shape: tuple[int, ...]
    low: Any
    high: Any


class Discrete(_Space):
    """An integer in [start, start + n)."""

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
    """An array of zeros and ones."""

    type: Literal["multi_binary"] = "multi_binary"
    shape: tuple[int, ...]
    dtype: str = "int8"


class DictSpace(_Space):
    """Named spaces."""

    type: Literal["dict"] = "dict"
    spaces: dict[str, "Space"]


Leaf = Box | Discrete | MultiDiscrete | MultiBinary
Space = Annotated[Box | Discrete | MultiDiscrete | MultiBinary | DictSpace, Field(discriminator="type")]


def inputs(space: Space) -> dict[str, Leaf]:
    """Return the leaf of each ONNX input, in the order of the graph's inputs."""
    return dict(_leaves(space))


def paths(space: Space) -> dict[str, tuple[str, ...]]:
    """Return the path of keys to the leaf of each ONNX input, in the order of `inputs`."""
    if not isinstance(space, DictSpace):
        return {OBSERVATION: ()}
    return {name: path for name, path, _ in leaf_paths(space)}


def _leaves(space: Space) -> Iterator[tuple[str, Leaf]]:
    if not isinstance(space, DictSpace):
        yield OBSERVATION, space
        return
    for name, path, _ in leaf_paths(space):
        leaf: Space = space
        for key in path:
            assert isinstance(leaf, DictSpace)
            leaf = leaf.spaces[key]
        assert not isinstance(leaf, DictSpace)
        yield name, leaf


def leaf_paths(space: DictSpace) -> list[tuple[str, tuple[str, ...], str]]:
    """Return name, path of keys and dtype of each leaf, in the order of `inputs`."""
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
