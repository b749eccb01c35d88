"""The protocol's names of element types, and NumPy's.

BYTES and BF16, which the protocol also has, are no element type of any space or graph here.
"""

import numpy as np
from numpy.typing import NDArray

DATATYPES = {
    "bool": "BOOL",
    "int8": "INT8",
    "int16": "INT16",
    "int32": "INT32",
    "int64": "INT64",
    "uint8": "UINT8",
    "uint16": "UINT16",
    "uint32": "UINT32",
    "uint64": "UINT64",
    "float16": "FP16",
    "float32": "FP32",
    "float64": "FP64",
}
"""NumPy's name → the protocol's."""

_BY_DTYPE = {np.dtype(name): datatype for name, datatype in DATATYPES.items()}  # a dtype's name takes microseconds


def datatype_of(array: NDArray) -> str:
    """The protocol's name of an array's element type."""
    return _BY_DTYPE[array.dtype]


def to_bytes(array: NDArray) -> bytes:
    """Elements as they travel: in row-major order, little-endian, a byte for a BOOL."""
    return array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()


def from_bytes(data: bytes | memoryview, dtype: str) -> NDArray:
    """The elements that travelled, in one dimension. The array may be read-only, and need not be aligned."""
    return np.frombuffer(data, np.dtype(dtype).newbyteorder("<"))
