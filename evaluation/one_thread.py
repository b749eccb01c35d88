"""Linear algebra on one thread: its matrices are too small for more, and on busy cores threads that wait for one
another cost many times what they save.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@contextmanager
def one_thread() -> Iterator[None]:
    """While the block runs, NumPy's and SciPy's BLAS use one thread in this process."""
    with _controller().limit(limits=1, user_api="blas"):
        yield


@cache
def _controller() -> ThreadpoolController:
    """Of the libraries that are loaded, which takes a moment to find out."""
    return ThreadpoolController()
