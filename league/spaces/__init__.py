"""Serialisable spaces, for manifests and for the validation of requests.

A value of a space is represented by one array per leaf, named after the ONNX input:

| space                                              | names                                                   |
|----------------------------------------------------|---------------------------------------------------------|
| a leaf (Box, Discrete, MultiDiscrete, MultiBinary) | `observation`                                           |
| Dict with an action mask and one more key          | `observation` (or its leaves), `action_mask`            |
| Dict with an action mask and several more keys     | `observation.<key>`, nested keys dotted, `action_mask`  |
| Dict without an action mask                        | `observation.<key>`, nested keys dotted                 |

The key `action_mask` of the outermost Dict is the action mask if the action space can have one.

Arrays are in arrays.py and conversions in conversion.py, because the command line reads manifests without NumPy, and a
serving replica handles arrays without Gymnasium.
"""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field

from league.frozen import FrozenModel

OBSERVATION = "observation"
ACTION_MASK = "action_mask"


class Box(FrozenModel):
    """An array of numbers. A bound is a number if all elements share it, else nested lists; None means infinite."""

    type: Literal["box"] = "box"
    dtype: str
    shape: tuple[int, ...]
    low: Any
    high: Any


class Discrete(FrozenModel):
    """An integer in [start, start + n)."""

    type: Literal["discrete"] = "discrete"
    n: int
    start: int = 0
    dtype: str = "int64"

    @property
    def shape(self) -> tuple[int, ...]:
        return ()


class MultiDiscrete(FrozenModel):
    """An array of integers, element i in [start_i, start_i + nvec_i)."""

    type: Literal["multi_discrete"] = "multi_discrete"
    nvec: Any
    start: Any
    shape: tuple[int, ...]
    dtype: str = "int64"


class MultiBinary(FrozenModel):
    """An array of zeros and ones."""

    type: Literal["multi_binary"] = "multi_binary"
    shape: tuple[int, ...]
    dtype: str = "int8"


class DictSpace(FrozenModel):
    """Named spaces.

    maskable: whether a key `action_mask` is the mask of the actions. Otherwise it is observed like any other.
    """

    type: Literal["dict"] = "dict"
    spaces: dict[str, "Space"]
    # Written only where a key of this name is not the mask, so that all other digests are those of plain spaces.
    maskable: bool = Field(default=True, exclude_if=bool)

    @property
    def is_masked(self) -> bool:
        """Whether values contain an action mask."""
        return self.maskable and ACTION_MASK in self.spaces


Leaf = Box | Discrete | MultiDiscrete | MultiBinary
Space = Annotated[Box | Discrete | MultiDiscrete | MultiBinary | DictSpace, Field(discriminator="type")]


def inputs(space: Space) -> dict[str, Leaf]:
    """Return the leaf of each ONNX input, in the order of the graph's inputs."""
    return {name: leaf for name, _, leaf in leaf_paths(space)}


def paths(space: Space) -> dict[str, tuple[str, ...]]:
    """Return the path of keys to the leaf of each ONNX input, in the order of `inputs`."""
    return {name: path for name, path, _ in leaf_paths(space)}


def leaf_paths(space: Space) -> list[tuple[str, tuple[str, ...], Leaf]]:
    """Return name, path of keys and space of each leaf, in the order of `inputs`."""
    path, observed = beside_mask(space)
    leaves = list(_walk(OBSERVATION, path, observed))
    if isinstance(space, DictSpace) and space.is_masked:
        leaves += _walk(ACTION_MASK, (ACTION_MASK,), space.spaces[ACTION_MASK])
    return leaves


def beside_mask(space: Space) -> tuple[tuple[str, ...], Space]:
    """Return what is observed beside the action mask, with its path: a Dict only if there is more than one key."""
    if not (isinstance(space, DictSpace) and space.is_masked):
        return (), space
    parts = {key: part for key, part in space.spaces.items() if key != ACTION_MASK}
    if len(parts) != 1:
        return (), DictSpace(spaces=parts)
    (key,) = parts
    return (key,), parts[key]


def _walk(name: str, path: tuple[str, ...], space: Space) -> Iterator[tuple[str, tuple[str, ...], Leaf]]:
    if isinstance(space, DictSpace):
        for key, part in space.spaces.items():
            yield from _walk(f"{name}.{key}", (*path, key), part)
    else:
        yield name, path, space
