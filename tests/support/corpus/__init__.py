"""Generated requests to every interface of inference, and the answers that were recorded for them.

A case is derived from its interface and its number alone. `python -m tests.support.corpus` compares the answers of this
code with the recorded ones, and `--write` records them anew.
"""

import json
import lzma
from pathlib import Path
from typing import Any

FEW, MANY = 200, 2000
"""Requests to each interface, or messages of streams: in each run of the tests, and all."""
RECORDED = Path(__file__).parents[2] / "data" / "corpus.json.xz"


def read() -> dict[str, dict[str, Any]]:
    """Interface → digest of a case → its answer; `counts` → when → what the replicas had counted."""
    recorded: dict[str, dict[str, Any]] = json.loads(lzma.decompress(RECORDED.read_bytes()))
    return recorded
