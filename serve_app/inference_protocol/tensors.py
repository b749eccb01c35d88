"""Tensors of a request → arrays that a graph takes, checked as the action route checks its observations.

Nothing is converted: a tensor has the datatype and the shape of the manifest, with the batch in front.
"""

from collections.abc import Sequence
from itertools import chain
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.errors import BodyTooLarge, ObservationError
from league.spaces import ACTION_MASK, check, check_mask
from serve_app.inference_protocol.datatypes import from_bytes
from serve_app.inference_protocol.signature import Port, Signature

NUMBERS = {int, float}
BOOLEANS = {bool}


class Tensor(NamedTuple):
    """A tensor as it came: declared, but nothing of it checked."""

    name: str
    datatype: str
    shape: Sequence[int]
    data: "Data"


Data = list[Any] | bytes | memoryview
"""Elements in row-major order: lists, flat or nested, or bytes, little-endian."""


def read_inputs(tensors: Sequence[Tensor], signature: Signature, max_batch: int) -> dict[str, NDArray]:
    """Input name → array (k, …); without the recurrent state, if none of it was given.

    Raises ObservationError, IllegalMask, or BodyTooLarge for a batch of more than `max_batch` rows.
    """
    arrays: dict[str, NDArray] = {}
    for tensor in tensors:
        port = signature.inputs.get(tensor.name)
        if port is None:
            known = ", ".join(signature.inputs)
            raise ObservationError(f"there is no input {tensor.name[:64]!r}, expected {known}")
        if tensor.name in arrays:
            raise ObservationError(f"input {tensor.name} is given twice")
        arrays[tensor.name] = _array(tensor, port, max_batch)
    _check_whole(arrays, signature)
    if signature.is_masked:
        check_mask(arrays[ACTION_MASK])
    return arrays


def _check_whole(arrays: dict[str, NDArray], signature: Signature) -> None:
    """Raise ObservationError unless every input is there, or all but the state, with as many rows each."""
    if len(arrays) < len(signature.inputs):
        has_state = any(port.is_state and name in arrays for name, port in signature.inputs.items())
        for name, port in signature.inputs.items():
            if name not in arrays and (has_state or not port.is_state):
                raise ObservationError(f"input {name} is missing")
    rows = {len(array) for array in arrays.values()}
    if len(rows) > 1:
        told = ", ".join(f"{name} has {len(array)}" for name, array in arrays.items())
        raise ObservationError(f"the inputs have different numbers of rows: {told}")


def _array(tensor: Tensor, port: Port, max_batch: int) -> NDArray:
    if tensor.datatype != port.datatype:
        raise ObservationError(f"{port.name} has datatype {str(tensor.datatype)[:64]}, expected {port.datatype}")
    shape = tuple(tensor.shape)
    if shape[1:] != port.leaf.shape or not shape or shape[0] < 1:
        expected = ["batch", *port.leaf.shape]
        raise ObservationError(f"{port.name} has shape {_list(shape[:16])}, expected {_list(expected)}")
    if shape[0] > max_batch:
        raise BodyTooLarge(f"{port.name} has {shape[0]} rows, expected at most {max_batch}")
    read = _listed if isinstance(tensor.data, list) else _framed
    return check(port.name, read(tensor.data, shape, port), port.leaf)  # type: ignore[arg-type]


def _framed(data: bytes | memoryview, shape: tuple[int, ...], port: Port) -> NDArray:
    if len(data) != (size := prod(shape) * np.dtype(port.leaf.dtype).itemsize):
        raise ObservationError(f"{port.name} has {len(data)} bytes, expected {size} for {_list(shape)} {port.datatype}")
    array = from_bytes(data, port.leaf.dtype)
    if port.datatype == "BOOL" and (array.view(np.uint8) > 1).any():
        raise ObservationError(f"{port.name} has bytes other than 0 and 1, expected BOOL")
    if not array.flags.aligned:  # it begins anywhere in the body, and a graph's kernels rely on alignment
        array = array.copy()
    return array.reshape(shape)


def _listed(data: list[Any], shape: tuple[int, ...], port: Port) -> NDArray:
    flat, kinds = data, set(map(type, data))
    while kinds == {list}:
        flat = list(chain.from_iterable(flat))
        kinds = set(map(type, flat))
    expected = BOOLEANS if port.leaf.dtype == "bool" else NUMBERS
    # Nothing else may reach NumPy: it would read "1" as a number, and make every element as wide as the longest string.
    if not kinds <= expected:
        raise ObservationError(f"{port.name} holds something other than {port.datatype}, or lists of unequal depth")
    if len(flat) != (size := prod(shape)):
        raise ObservationError(f"{port.name} has {len(flat)} elements, expected {size} for {_list(shape)}")
    dtype = np.dtype(port.leaf.dtype)
    try:
        with np.errstate(over="ignore"):  # what overflows becomes infinite, and is refused as such
            array = np.array(flat, None if float in kinds and dtype.kind in "iu" else dtype)
    except OverflowError:
        raise ObservationError(f"{port.name} holds a number that does not fit {port.datatype}") from None
    return array.reshape(shape)


def _list(sizes: Sequence[Any]) -> str:
    return "[" + ", ".join(map(str, sizes)) + "]"
