"""Limits BLAS to one thread, which is faster for small matrices on busy machines."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController

controller = cache(ThreadpoolController)
"""Returns the controller of the loaded libraries. Finding them takes a moment."""


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Context manager: the BLAS of NumPy and SciPy uses one thread in this process."""
    with controller().limit(limits=1, user_api="blas"):
        yield
