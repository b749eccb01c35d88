"""JSON values of an observation space → the arrays that a policy's graph takes."""

from collections.abc import Iterable, KeysView, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.errors import ObservationError
from league.spaces import ACTION_MASK, Leaf, Space, check, check_mask, inputs, paths
from serve_app.encoded import decode, is_encoded, refuse_large

JSON_KINDS = {dict: "an object", list: "a list", str: "a string", bool: "a boolean", int: "a number", float: "a number"}


class ObservationReader:
    """Reads observations of one space: leaves as nested lists or base64, in objects where the space is a Dict."""

    def __init__(self, space: Space) -> None:
        keys = paths(space)
        self.leaves: tuple[tuple[str, tuple[str, ...], Leaf], ...] = tuple(
            (name, keys[name], leaf) for name, leaf in inputs(space).items()
        )
        self.is_masked = ACTION_MASK in keys
        self._objects = _objects(keys.values())

    @property
    def keys(self) -> int:
        """How many keys the objects of one observation have."""
        return sum(len(keys) for keys in self._objects.values())

    def read(self, observations: Sequence[Any], is_plain: bool = False) -> dict[str, NDArray]:
        """A batch for the graph, checked. Raises ObservationError, IllegalMask or BodyTooLarge.

        is_plain: no value is a string, so that nothing is base64. NumPy must see no string: see `refuse_strings`.
        """
        for observation in observations:
            self._check_objects(observation)
        arrays = {}
        for name, path, leaf in self.leaves:
            rows = [_at(value, path) for value in observations]
            if not is_plain:
                refuse_large(name, rows, leaf)
                rows = [_decoded(name, row, leaf) for row in rows]
            arrays[name] = check(name, _array(name, rows, leaf), leaf)
        if self.is_masked:
            check_mask(arrays[ACTION_MASK])
        return arrays

    def zeros(self, batch: int) -> dict[str, NDArray]:
        """Observations of nothing, in which every action is legal."""
        fill = {name: int(name == ACTION_MASK) for name, _, _ in self.leaves}
        return {name: np.full((batch, *leaf.shape), fill[name], leaf.dtype) for name, _, leaf in self.leaves}

    def _check_objects(self, observation: Any) -> None:
        for path, keys in self._objects.items():
            value = _at(observation, path)
            where = ".".join(("observation", *path))
            if type(value) is not dict:
                raise ObservationError(f"{where} is {kind(value)}, expected an object with {', '.join(keys)}")
            if value.keys() == keys:
                continue
            for key in sorted(keys - value.keys()):
                raise ObservationError(f"{where} has no {key}, expected an object with {', '.join(keys)}")
            unknown = min(value.keys() - keys)
            raise ObservationError(f"{where} has the unknown key {unknown[:64]!r}, expected {', '.join(keys)}")


def read_state(value: Any, leaves: Iterable[tuple[str, Leaf]], batch: int) -> dict[str, NDArray]:
    """Recurrent state as an earlier reply gave it: name → nested lists with one row per observation."""
    expected = dict(leaves)
    if type(value) is not dict or value.keys() != expected.keys():
        raise ObservationError(f"state must be null or the state of an earlier reply, with {', '.join(expected)}")
    arrays = {name: check(name, _array(name, value[name], leaf), leaf) for name, leaf in expected.items()}
    for name, array in arrays.items():
        if len(array) != batch:
            raise ObservationError(f"{name} has {len(array)} rows, expected {batch}: one per observation")
    return arrays


def refuse_strings(document: Any) -> None:
    """Raise ObservationError if there is a string among the values of a JSON document.

    NumPy reads "1" as a number, and makes every element of an array as wide as its longest string: a small body could
    ask for gigabytes.
    """
    pending = [document]
    while pending:
        value = pending.pop()
        if type(value) is dict:
            pending.extend(value.values())
        elif type(value) is list:
            pending.extend(value)
        elif type(value) is str:
            raise ObservationError(f"the string {value[:64]!r} stands where a number is expected")


def kind(value: Any) -> str:
    """What a JSON value is, in a person's words."""
    return JSON_KINDS.get(type(value), "null")


def _objects(leaf_paths: Iterable[tuple[str, ...]]) -> dict[tuple[str, ...], KeysView[str]]:
    """Where objects stand in an observation → their keys, outer objects first."""
    objects: dict[tuple[str, ...], dict[str, None]] = {}
    for path in leaf_paths:
        for depth, key in enumerate(path):
            objects.setdefault(path[:depth], {})[key] = None
    return {path: keys.keys() for path, keys in objects.items()}


def _at(value: Any, path: tuple[str, ...]) -> Any:
    for key in path:
        value = value[key]
    return value


def _decoded(name: str, value: Any, leaf: Leaf) -> Any:
    """An array if the leaf is base64, else what it is, if there is no string in it."""
    if is_encoded(value):
        return decode(name, value, leaf)
    refuse_strings(value)
    return value


def _array(name: str, rows: Any, leaf: Leaf) -> NDArray:
    try:
        array = np.array(rows)
    except ValueError:
        raise ObservationError(f"{name} is ragged, expected {leaf.dtype} of shape {list(leaf.shape)}") from None
    if array.dtype == object:
        raise ObservationError(
            f"{name} holds something other than numbers, expected {leaf.dtype} of shape {list(leaf.shape)}"
        )
    return array
