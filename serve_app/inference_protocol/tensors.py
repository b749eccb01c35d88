"""Tensors of the Open Inference Protocol: datatypes, and checked inputs of requests.

BYTES and BF16 are not supported: no space or graph has elements of these types. Nothing is converted: a tensor must
have the datatype and shape of the manifest, with the batch as the first dimension.
"""

from collections.abc import Sequence
from itertools import chain
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.errors import BodyTooLarge, ObservationError
from league.policies.open_inference import DATATYPES
from league.policies.policy import Arrays
from league.spaces import ACTION_MASK
from league.spaces.arrays import check, check_mask
from serve_app.inference.stream_codec import BinaryObservations, binary_array
from serve_app.live_versions.policies import LoadedPolicy, Port

_BY_DTYPE = {
    np.dtype(name): datatype for name, datatype in DATATYPES.items()
}  # computing a dtype's name takes microseconds


def datatype_of(array: NDArray) -> str:
    """The protocol's datatype of an array."""
    return _BY_DTYPE[array.dtype]


def to_bytes(array: NDArray) -> bytes:
    """Elements in wire format: row-major, little-endian, one byte per BOOL."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()


NUMBERS = {int, float}
BOOLEANS = {bool}
ELEMENTS = 8192
"""Elements that are converted at once."""


class RequestTensor(NamedTuple):
    """A tensor of a request, not checked yet."""

    name: str
    datatype: str
    shape: Sequence[int]
    data: "Data"


Data = Sequence[Any] | bytes | memoryview
"""Elements in row-major order: lists, flat or nested, or little-endian bytes."""


class Inputs(NamedTuple):
    """The inputs of a request with lists or recurrent state, or of a large one. See `RequestRows`."""

    tensors: Sequence[RequestTensor]
    rows: int
    is_large: bool
    is_joinable: bool = False

    @staticmethod
    def read(policy: LoadedPolicy, parts: Sequence["Inputs"]) -> Arrays:
        """See `RequestRows`. Raises ObservationError or IllegalMask."""
        (part,) = parts
        arrays = {tensor.name: _array(tensor, policy.inputs[tensor.name]) for tensor in part.tensors}
        if policy.is_masked:
            check_mask(arrays[ACTION_MASK])
        return arrays


def checked_inputs(
    tensors: Sequence[RequestTensor], policy: LoadedPolicy, max_batch: int, is_large: bool
) -> Inputs | BinaryObservations:
    """The inputs of a request, if their names, datatypes, shapes and sizes are those of a policy.

    Raises ObservationError, or BodyTooLarge for more than `max_batch` rows.
    """
    data: dict[str, Data] = {}
    for tensor in tensors:
        port = policy.inputs.get(tensor.name)
        if port is None:
            input_names = ", ".join(policy.inputs)
            raise ObservationError(f"unknown input {tensor.name[:64]!r}, expected {input_names}")
        if tensor.name in data:
            raise ObservationError(f"input {tensor.name} is given twice")
        _check_layout(tensor, port, max_batch)
        data[tensor.name] = tensor.data
    # All inputs, or all but the state, must be there.
    if len(data) < len(policy.inputs):
        has_state = any(port.is_state and name in data for name, port in policy.inputs.items())
        for name, port in policy.inputs.items():
            if name not in data and (has_state or not port.is_state):
                raise ObservationError(f"input {name} is missing")
    rows = tensors[0].shape[0]
    if any(tensor.shape[0] != rows for tensor in tensors):
        sizes = ", ".join(f"{tensor.name} has {tensor.shape[0]}" for tensor in tensors)
        raise ObservationError(f"the inputs have different numbers of rows: {sizes}")
    observed = [data[port.name] for port in policy.observed]
    parts = [part for part in observed if isinstance(part, bytes | memoryview)]
    if is_large or len(parts) < len(data):
        return Inputs(tensors, rows, is_large)
    return BinaryObservations(parts, rows)


def _check_layout(tensor: RequestTensor, port: Port, max_batch: int) -> None:
    if tensor.datatype != port.datatype:
        raise ObservationError(f"{port.name} has datatype {str(tensor.datatype)[:64]}, expected {port.datatype}")
    shape = tuple(tensor.shape)
    if shape[1:] != port.leaf.shape or not shape or shape[0] < 1:
        expected = ["batch", *port.leaf.shape]
        raise ObservationError(f"{port.name} has shape {_list(shape[:16])}, expected {_list(expected)}")
    if shape[0] > max_batch:
        raise BodyTooLarge(f"{port.name} has {shape[0]} rows, expected at most {max_batch}")
    if isinstance(tensor.data, bytes | memoryview) and len(tensor.data) != (size := shape[0] * port.row_bytes):
        raise ObservationError(
            f"{port.name} has {len(tensor.data)} bytes, expected {size} for {_list(shape)} {port.datatype}"
        )


def _array(tensor: RequestTensor, port: Port) -> NDArray:
    shape, data = tuple(tensor.shape), tensor.data
    if isinstance(data, bytes | memoryview):
        return binary_array(port, data, shape[0])
    return check(port.name, (_from_list if isinstance(data, list) else _from_field)(data, shape, port), port.leaf)


def _from_field(data: Sequence[Any], shape: tuple[int, ...], port: Port) -> NDArray:
    """The elements of a field of a gRPC message, whose type is that of the datatype.

    They are converted in parts: the interpreter serves nobody else while it converts one.
    """
    if len(data) != (size := prod(shape)):
        raise _wrong_size(port, len(data), size, shape)
    array = np.empty(size, port.leaf.dtype)
    try:
        for begin in range(0, size, ELEMENTS):
            array[begin : begin + ELEMENTS] = data[begin : begin + ELEMENTS]
    except OverflowError:
        raise _out_of_range(port) from None
    return array.reshape(shape)


def _from_list(data: Sequence[Any], shape: tuple[int, ...], port: Port) -> NDArray:
    if len(data) > (size := prod(shape)):
        raise _wrong_size(port, len(data), size, shape)
    flat = data
    kinds = set(map(type, flat))
    while kinds == {list}:
        flat = list(chain.from_iterable(flat))
        kinds = set(map(type, flat))
    expected = BOOLEANS if port.leaf.dtype == "bool" else NUMBERS
    # NumPy would parse "1" as a number, and make every element as wide as the longest string.
    if not kinds <= expected:
        raise ObservationError(f"{port.name} contains values other than {port.datatype}, or lists of unequal depth")
    if len(flat) != size:
        raise _wrong_size(port, len(flat), size, shape)
    dtype = np.dtype(port.leaf.dtype)
    try:
        with np.errstate(over="ignore"):  # overflow becomes infinity, which is refused
            array = np.array(flat, None if float in kinds and dtype.kind in "iu" else dtype)
    except OverflowError:
        raise _out_of_range(port) from None
    return array.reshape(shape)


def _wrong_size(port: Port, elements: int, expected: int, shape: tuple[int, ...]) -> ObservationError:
    return ObservationError(f"{port.name} has {elements} elements, expected {expected} for {_list(shape)}")


def _out_of_range(port: Port) -> ObservationError:
    return ObservationError(f"{port.name} contains a number out of range for {port.datatype}")


def _list(sizes: Sequence[Any]) -> str:
    return "[" + ", ".join(map(str, sizes)) + "]"
