"""How gradient steps use the processor: memory that stays with the process, and the arithmetic of matrix products."""

import ctypes
import platform
from collections.abc import Iterator
from contextlib import contextmanager

import torch

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3)."""
KEPT_MEMORY = 2**28
"""Bytes of free memory that the process keeps, more than the intermediate results of a gradient step."""
LARGEST_KEPT = 2**25
"""Bytes of the largest block that is kept, the maximum in glibc."""


def keep_memory() -> None:
    """Let the process keep freed memory for the next gradient step, with glibc; elsewhere nothing changes.

    By default, glibc returns the large intermediate results of each gradient step to the kernel, which then provides
    empty pages for the next one: about a quarter of the processor time of small convolutional networks.
    """
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT)
        libc.mallopt(M_TRIM_THRESHOLD, KEPT_MEMORY)


@contextmanager
def fast_products() -> Iterator[None]:
    """Multiply float32 matrices by oneDNN, on the CPU.

    It rounds the factors to bfloat16 where the processor multiplies such matrices (AMX), and sums in float32.
    Otherwise it computes in float32, on AMD's processors about twice as fast as torch's default library.
    """
    matmul = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]
    before = matmul.fp32_precision
    matmul.fp32_precision = "bf16"
    try:
        yield
    finally:
        matmul.fp32_precision = before
