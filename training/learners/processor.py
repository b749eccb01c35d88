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
    """Let the process keep freed memory for the next gradient step, with glibc, and reuse it as it is.

    By default, glibc returns the large intermediate results of each gradient step to the kernel, which then provides
    empty pages for the next one: about a quarter of the processor time of small convolutional networks. With the
    deterministic algorithms that RLlib selects, torch would write NaN to all memory before it writes the results.
    """
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT)
        libc.mallopt(M_TRIM_THRESHOLD, KEPT_MEMORY)


@contextmanager
def fast_products() -> Iterator[None]:
    """Multiply float32 matrices by oneDNN, on the CPU, and let it round the factors to bfloat16; on a GPU, to TF32.

    It does so where the processor multiplies such matrices (AMX), and sums in float32. Otherwise it computes in
    float32, on AMD's processors about twice as fast as torch's default library. Encoders round on all processors
    that multiply bfloat16.
    """
    precisions = {torch.backends.mkldnn.matmul: "bf16", torch.backends.cuda.matmul: "tf32"}  # type: ignore[attr-defined]
    before = {matmul: matmul.fp32_precision for matmul in precisions}
    for matmul, precision in precisions.items():
        matmul.fp32_precision = precision
    try:
        yield
    finally:
        for matmul, precision in before.items():
            matmul.fp32_precision = precision
