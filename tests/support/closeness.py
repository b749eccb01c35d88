"""Equality of results up to rounding, which differs between processors and BLAS kernels."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def close(actual: Any, expected: Any, tolerance: float = 1e-9) -> bool:
    """Whether two values are equal, except that floats may differ by `tolerance`, relative or absolute.

    Compares dataclasses, mappings, sequences and arrays element by element. All other values must be equal.
    """
    if isinstance(actual, np.ndarray) or isinstance(expected, np.ndarray):
        return bool(np.shape(actual) == np.shape(expected)) and bool(
            np.allclose(actual, expected, rtol=tolerance, atol=tolerance)
        )
    if isinstance(actual, float) or isinstance(expected, float):
        return (
            isinstance(actual, int | float)
            and isinstance(expected, int | float)
            and math.isclose(actual, expected, rel_tol=tolerance, abs_tol=tolerance)
        )
    if is_dataclass(actual) and type(actual) is type(expected):
        names = [field.name for field in fields(actual)]
        return all(close(getattr(actual, name), getattr(expected, name), tolerance) for name in names)
    if isinstance(actual, Mapping) and isinstance(expected, Mapping):
        return actual.keys() == expected.keys() and all(close(actual[key], expected[key], tolerance) for key in actual)
    if isinstance(actual, Sequence) and isinstance(expected, Sequence) and not isinstance(actual, str | bytes):
        return len(actual) == len(expected) and all(
            close(*pair, tolerance) for pair in zip(actual, expected, strict=True)
        )
    return bool(actual == expected)
