"""Pictures of a game that go into a page or a JSON document: small PNGs as data URIs."""

from __future__ import annotations

from base64 import b64encode
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

COLORS = 48


def data_uri(pixels: NDArray, largest: int) -> str:
    """(height, width, 3) uint8 → a PNG whose longer side has at most `largest` pixels.

    Those of less than half of that are enlarged by a whole factor, so that their pixels stay square and sharp.
    """
    image = Image.fromarray(np.ascontiguousarray(pixels))
    longer = max(image.size)
    factor = largest / longer if longer > largest else max(1, largest // 2 // longer)
    size = (max(1, round(image.width * factor)), max(1, round(image.height * factor)))
    scaled = image.resize(size, Image.Resampling.NEAREST if factor >= 1 else Image.Resampling.HAMMING)
    # An octree keeps the colours of small things, which a median cut spends on the background; and takes a tenth.
    few = scaled.quantize(COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    out = BytesIO()
    few.save(out, "PNG", optimize=True)
    return f"data:image/png;base64,{b64encode(out.getvalue()).decode()}"
