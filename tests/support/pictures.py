"""PNG images."""

from io import BytesIO
from typing import Any

from numpy.typing import NDArray
from PIL import Image

MODES = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}


def png(pixels: NDArray, **options: Any) -> bytes:
    """A PNG of pixels (H, W) or (H, W, C)."""
    values = pixels.shape[2] if pixels.ndim == 3 else 1
    buffer = BytesIO()
    image = Image.frombytes(MODES[values], (pixels.shape[1], pixels.shape[0]), pixels.tobytes())
    image.save(buffer, "PNG", **options)
    return buffer.getvalue()
