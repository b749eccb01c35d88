"""Tensors of the Open Inference Protocol: datatypes, the signature of a policy, and checked request inputs.

BYTES and BF16 are not supported: no space or graph has elements of these types. Nothing is converted: a tensor must
have the datatype and shape of the manifest, with the batch as the first dimension.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.errors import BodyTooLarge, ObservationError
from league.policies.onnx import ACTION, DIST_INPUTS, STATE_OUT
from league.policies.open_inference import DATATYPES
from league.registry.storage.manifest import PolicyManifest
from league.spaces import ACTION_MASK, Box, Leaf, inputs
from league.spaces.arrays import check, check_mask
from league.spaces.binary_leaves import little_endian

_BY_DTYPE = {
    np.dtype(name): datatype for name, datatype in DATATYPES.items()
}  # computing a dtype's name takes microseconds


def datatype_of(array: NDArray) -> str:
    """The protocol's datatype of an array."""
    return _BY_DTYPE[array.dtype]


def to_bytes(array: NDArray) -> bytes:
    """Elements in wire format: row-major, little-endian, one byte per BOOL."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()


@dataclass(frozen=True, slots=True)
class TensorSpec:
    """The specification of one input or output."""

    name: str
    datatype: str
    leaf: Leaf
    """Shape of a row, dtype, and permitted values."""
    is_state: bool = False
    """Whether it is recurrent state, which may be omitted at the start of an episode."""


@dataclass(frozen=True, slots=True)
class Signature:
    """Inputs and outputs of a policy by name, in the order of the manifest."""

    inputs: dict[str, TensorSpec]
    outputs: dict[str, TensorSpec]
    is_masked: bool

    @property
    def is_recurrent(self) -> bool:
        return any(port.is_state for port in self.inputs.values())


def signature_of(manifest: PolicyManifest) -> Signature:
    """Inputs are the leaves of the observation and the recurrent state; outputs are the fields of `Actions`."""
    observed = {name: _tensor_spec(name, leaf) for name, leaf in inputs(manifest.observation).items()}
    state = {
        tensor.name: _tensor_spec(tensor.name, _leaf(tensor.dtype, tensor.shape), True) for tensor in manifest.state
    }
    answered = {
        tensor.name: _tensor_spec(tensor.name, _leaf(tensor.dtype, tensor.shape))
        for tensor in manifest.outputs
        if tensor.name in (ACTION, DIST_INPUTS) or tensor.name.startswith(STATE_OUT)
    }
    return Signature(observed | state, answered, ACTION_MASK in observed)


def _tensor_spec(name: str, leaf: Leaf, is_state: bool = False) -> TensorSpec:
    return TensorSpec(name, DATATYPES[leaf.dtype], leaf, is_state)


def _leaf(dtype: str, shape: tuple[int | None, ...]) -> Leaf:
    """A tensor without its batch dimension, the only one without a fixed size."""
    return Box(dtype=dtype, shape=tuple(size for size in shape[1:] if size is not None), low=None, high=None)


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


def read_inputs(tensors: Sequence[RequestTensor], signature: Signature, max_batch: int) -> dict[str, NDArray]:
    """Check the inputs of a request; input name → array (k, …), without the recurrent state if it is omitted.

    Raises ObservationError, IllegalMask, or BodyTooLarge for more than `max_batch` rows.
    """
    arrays: dict[str, NDArray] = {}
    for tensor in tensors:
        port = signature.inputs.get(tensor.name)
        if port is None:
            input_names = ", ".join(signature.inputs)
            raise ObservationError(f"unknown input {tensor.name[:64]!r}, expected {input_names}")
        if tensor.name in arrays:
            raise ObservationError(f"input {tensor.name} is given twice")
        arrays[tensor.name] = _array(tensor, port, max_batch)
    # All inputs, or all but the state, must be there.
    if len(arrays) < len(signature.inputs):
        has_state = any(port.is_state and name in arrays for name, port in signature.inputs.items())
        for name, port in signature.inputs.items():
            if name not in arrays and (has_state or not port.is_state):
                raise ObservationError(f"input {name} is missing")
    rows = {len(array) for array in arrays.values()}
    if len(rows) > 1:
        sizes = ", ".join(f"{name} has {len(array)}" for name, array in arrays.items())
        raise ObservationError(f"the inputs have different numbers of rows: {sizes}")
    if signature.is_masked:
        check_mask(arrays[ACTION_MASK])
    return arrays


def _array(tensor: RequestTensor, port: TensorSpec, max_batch: int) -> NDArray:
    if tensor.datatype != port.datatype:
        raise ObservationError(f"{port.name} has datatype {str(tensor.datatype)[:64]}, expected {port.datatype}")
    shape = tuple(tensor.shape)
    if shape[1:] != port.leaf.shape or not shape or shape[0] < 1:
        expected = ["batch", *port.leaf.shape]
        raise ObservationError(f"{port.name} has shape {_list(shape[:16])}, expected {_list(expected)}")
    if shape[0] > max_batch:
        raise BodyTooLarge(f"{port.name} has {shape[0]} rows, expected at most {max_batch}")
    if isinstance(tensor.data, bytes | memoryview):
        if len(tensor.data) != (size := prod(shape) * np.dtype(port.leaf.dtype).itemsize):
            raise ObservationError(
                f"{port.name} has {len(tensor.data)} bytes, expected {size} for {_list(shape)} {port.datatype}"
            )
        dtype = np.dtype(port.leaf.dtype).newbyteorder("<")
        return check(port.name, little_endian(port.name, tensor.data, dtype, "BOOL").reshape(shape), port.leaf)
    read = _from_list if isinstance(tensor.data, list) else _from_field
    return check(port.name, read(tensor.data, shape, port), port.leaf)


def _from_field(data: Sequence[Any], shape: tuple[int, ...], port: TensorSpec) -> NDArray:
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


def _from_list(data: Sequence[Any], shape: tuple[int, ...], port: TensorSpec) -> NDArray:
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


def _wrong_size(port: TensorSpec, elements: int, expected: int, shape: tuple[int, ...]) -> ObservationError:
    return ObservationError(f"{port.name} has {elements} elements, expected {expected} for {_list(shape)}")


def _out_of_range(port: TensorSpec) -> ObservationError:
    return ObservationError(f"{port.name} contains a number out of range for {port.datatype}")


def _list(sizes: Sequence[Any]) -> str:
    return "[" + ", ".join(map(str, sizes)) + "]"
