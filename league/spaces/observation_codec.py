"""Decodes JSON observations to the input arrays of a policy."""

from collections.abc import Iterable, KeysView, Sequence
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.errors import ObservationError
from league.spaces import ACTION_MASK, Leaf, Space, leaf_paths, paths
from league.spaces.arrays import at_path, check, check_mask
from league.spaces.binary_leaves import check_decoded_size, decode, is_encoded

BYTES = ("int8", "uint8")
"""Data types of elements of one byte."""
EXACT = 2.0**53
"""Up to this number, floats contain all integers."""
JSON_TYPES = {dict: "an object", list: "a list", str: "a string", bool: "a boolean", int: "a number", float: "a number"}


class ObservationReader:
    """Decodes observations of one space: leaves as nested lists or base64, in objects where the space is a Dict."""

    def __init__(self, space: Space) -> None:
        self.leaves = leaf_paths(space)
        keys = paths(space)
        self.is_masked = ACTION_MASK in keys
        self._objects = _objects(keys.values())
        self.keys = sum(len(names) for names in self._objects.values())
        """Number of object keys in one observation."""

    def read(
        self, observations: Sequence[Any], is_plain: bool = False, is_mixed: bool = False, is_last: bool = False
    ) -> dict[str, NDArray]:
        """Decode and check a batch. Raises ObservationError, IllegalMask or BodyTooLarge.

        is_plain: no value is a string, so no leaf is base64. NumPy must not see strings: see `reject_strings`.
        is_mixed: the observations are of several requests. A batch is refused where one of them changes another's:
        beside a float, an integer is converted to a float, and above 2^53 to another number.
        is_last: nobody acts on the observations, so that masks may allow no action.
        """
        for observation in observations:
            self._check_objects(observation)
        arrays = {}
        for name, path, leaf in self.leaves:
            rows = [at_path(value, path) for value in observations]
            if not is_plain:
                check_decoded_size(name, rows, leaf)
                for place, row in enumerate(rows):
                    if is_encoded(row):
                        rows[place] = decode(name, row, leaf)
                    else:
                        reject_strings(row)
            # Otherwise rows may be decoded arrays.
            array = _bytes(rows, leaf) if is_plain and leaf.dtype in BYTES else None
            if array is None:
                array = _array(name, rows, leaf)
            if is_mixed and array.dtype.kind == "f" and not (np.abs(array) <= EXACT).all():
                raise ObservationError(f"{name} is not exact in one array")
            arrays[name] = check(name, array, leaf)
        if self.is_masked and not is_last:
            check_mask(arrays[ACTION_MASK])
        return arrays

    def zeros(self, batch: int) -> dict[str, NDArray]:
        """A batch of zero observations in which every action is legal."""
        fill = {name: int(name == ACTION_MASK) for name, _, _ in self.leaves}
        return {name: np.full((batch, *leaf.shape), fill[name], leaf.dtype) for name, _, leaf in self.leaves}

    def _check_objects(self, observation: Any) -> None:
        for path, keys in self._objects.items():
            value = at_path(observation, path)
            if type(value) is dict and value.keys() == keys:
                continue
            where = ".".join(("observation", *path))
            if type(value) is not dict:
                raise ObservationError(f"{where} is {json_type(value)}, expected an object with {', '.join(keys)}")
            for key in sorted(keys - value.keys()):
                raise ObservationError(f"{where} lacks the key {key}, expected an object with {', '.join(keys)}")
            unknown = min(value.keys() - keys)
            raise ObservationError(f"{where} has the unknown key {unknown[:64]!r}, expected {', '.join(keys)}")


def reject_strings(document: Any) -> None:
    """Raise ObservationError if a JSON document contains a string as a value.

    NumPy would parse "1" as a number, and make every element of an array as wide as its longest string, so that a small
    body could allocate gigabytes.
    """
    pending = [document]
    while pending:
        value = pending.pop()
        if type(value) is dict:
            pending.extend(value.values())
        elif type(value) is list:
            pending.extend(value)
        elif type(value) is str:
            raise ObservationError(f"found the string {value[:64]!r} where a number is expected")


def json_type(value: Any) -> str:
    """The JSON type of a value, for error messages."""
    return JSON_TYPES.get(type(value), "null")


def _objects(leaf_paths: Iterable[tuple[str, ...]]) -> dict[tuple[str, ...], KeysView[str]]:
    """Path of each object in an observation → its keys, outer objects first."""
    objects: dict[tuple[str, ...], dict[str, None]] = {}
    for path in leaf_paths:
        for depth, key in enumerate(path):
            objects.setdefault(path[:depth], {})[key] = None
    return {path: keys.keys() for path, keys in objects.items()}


def _bytes(rows: list[Any], leaf: Leaf) -> NDArray | None:
    """The array of nested lists of integers of one byte, which takes half the time of NumPy's conversion; None for
    others, valid or not.
    """
    values = rows
    try:
        for size in leaf.shape:
            if set(map(len, values)) != {size}:
                return None
            values = list(chain.from_iterable(values))
        data = bytes(values)
    except (TypeError, ValueError):
        return None
    if leaf.dtype == "int8" and not data.isascii():  # more than 127
        return None
    return np.frombuffer(data, leaf.dtype).reshape(len(rows), *leaf.shape)


def _array(name: str, rows: Any, leaf: Leaf) -> NDArray:
    try:
        array = np.array(rows)
    except ValueError:
        raise ObservationError(f"{name} is ragged, expected {leaf.dtype} of shape {list(leaf.shape)}") from None
    if array.dtype == object:
        raise ObservationError(
            f"{name} contains values that are not numbers, expected {leaf.dtype} of shape {list(leaf.shape)}"
        )
    return array
