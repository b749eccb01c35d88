"""Encodes the binary messages of a stream: a header of 16 bytes followed by tensors, little-endian.

    request   format 1 · flags · 0 · rows · seed             if flagged, one byte per row: 1 starts an episode
              then each input of the policy in the order of its manifest, without recurrent state: rows × its shape
    response  format 1 · 0 · 0 · rows · version · 0          then the actions: rows × the shape of an action

With 16 bytes the first tensor is aligned in memory and can be used without a copy.
"""

import struct
from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from league.errors import BodyTooLarge, InvalidInput, ObservationError
from league.policies.onnx import ACTION
from league.policies.policy import Arrays
from league.spaces import ACTION_MASK
from league.spaces.arrays import check, check_mask
from league.spaces.binary_leaves import little_endian
from serve_app.live_versions.policies import ActionOptions, LoadedPolicy, Port

FRAMING = 1
REQUEST = struct.Struct("<BBHIQ")
RESPONSE = struct.Struct("<BBHIII")
EXPLORE, HAS_SEED, RESET, HAS_RESETS, GREEDY = 1, 2, 4, 8, 16
FLAGS = EXPLORE | HAS_SEED | RESET | HAS_RESETS | GREEDY


class BinaryRequest(NamedTuple):
    """A request with a parsed header."""

    rows: int
    options: ActionOptions
    reset: bool
    resets: NDArray | None
    """(rows,) bool: where an episode starts."""
    tensors: memoryview


class BinaryObservations(NamedTuple):
    """See `RequestRows`. parts: the bytes of each input, in the order of the manifest, without recurrent state."""

    parts: Sequence[bytes | memoryview]
    rows: int
    is_joinable: bool = True
    is_large: bool = False

    @staticmethod
    def read(policy: LoadedPolicy, parts: Sequence["BinaryObservations"]) -> Arrays:
        """See `RequestRows`. Raises ObservationError or IllegalMask."""
        inputs, rows = parts[0].parts, parts[0].rows
        if len(parts) > 1:
            inputs = [b"".join(inputs) for inputs in zip(*(part.parts for part in parts), strict=True)]
            rows = sum(part.rows for part in parts)
        arrays = {port.name: binary_array(port, data, rows) for port, data in zip(policy.observed, inputs, strict=True)}
        if policy.is_masked:
            check_mask(arrays[ACTION_MASK])
        return arrays


def binary_array(port: Port, data: bytes | memoryview, rows: int) -> NDArray:
    """The array (rows, …) of an input of a graph from its bytes. Raises ObservationError."""
    array = little_endian(port.name, data, port.dtype, port.datatype).reshape(rows, *port.leaf.shape)
    return check(port.name, array, port.leaf)


def binary_observations(policy: LoadedPolicy, request: BinaryRequest) -> BinaryObservations:
    """The observations of a request. Raises ObservationError."""
    if len(request.tensors) != (size := request.rows * sum(port.row_bytes for port in policy.observed)):
        parts = " + ".join(f"{port.row_bytes} {port.name}" for port in policy.observed)
        raise ObservationError(
            f"the tensors have {len(request.tensors)} bytes, expected {size}: {request.rows} rows of {parts}"
        )
    ends = list(accumulate(request.rows * port.row_bytes for port in policy.observed))
    return BinaryObservations(
        [request.tensors[begin:end] for begin, end in zip([0, *ends], ends, strict=False)], request.rows
    )


def write_actions(policy: LoadedPolicy, actions: NDArray) -> bytes:
    """Encode the response."""
    head = RESPONSE.pack(FRAMING, 0, 0, len(actions), policy.number, 0)
    return head + actions.astype(policy.outputs[ACTION].dtype, copy=False).tobytes()


def parse_request(message: bytes, max_batch: int) -> BinaryRequest:
    """Parse the header of a message. Raises InvalidInput or BodyTooLarge."""
    if len(message) < REQUEST.size:
        raise InvalidInput(f"the message has {len(message)} bytes, expected a header of {REQUEST.size}")
    framing, flags, zero, rows, seed = REQUEST.unpack_from(message)
    if framing != FRAMING or zero or flags & ~FLAGS:
        raise InvalidInput(f"the header starts with {message[:4].hex(' ')}, expected {FRAMING:02x}, flags, 00 00")
    if not 1 <= rows <= max_batch:
        refusal = BodyTooLarge if rows else InvalidInput
        raise refusal(f"the message has {rows} rows, expected 1 to {max_batch}")
    if flags & EXPLORE and flags & GREEDY:
        raise InvalidInput(f"the flags are {flags}, expected {EXPLORE} (explore) or {GREEDY} (greedy), not both")
    explore = True if flags & EXPLORE else False if flags & GREEDY else None
    has_seed = bool(flags & HAS_SEED)
    if seed >= 2**63 or (seed and not has_seed):
        raise InvalidInput("seed must be less than 2^63, and 0 if there is none")
    begin, resets = REQUEST.size, None
    if flags & HAS_RESETS:
        begin += rows
        resets = _resets(message[REQUEST.size : begin], rows)
    tensors = memoryview(message)[begin:]
    return BinaryRequest(rows, ActionOptions(explore, seed if has_seed else None), bool(flags & RESET), resets, tensors)


def _resets(data: bytes, rows: int) -> NDArray:
    if len(data) != rows or data.strip(b"\0\1"):
        raise InvalidInput(f"resets must be {rows} bytes of 0 or 1")
    return np.frombuffer(data, np.bool_)


def encode_request(
    tensors: Iterable[NDArray], rows: int, seed: int | None = None, explore: bool | None = None, reset: bool = False
) -> bytes:
    """Encode a message as a client does."""
    flags = (0 if explore is None else EXPLORE if explore else GREEDY) | (seed is not None) * HAS_SEED | reset * RESET
    head = REQUEST.pack(FRAMING, flags, 0, rows, seed or 0)
    return head + b"".join(tensor.tobytes() for tensor in tensors)
