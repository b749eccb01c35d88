"""What the product did when it was recorded, and does still: `tests/data/NAME.json.xz`, case → JSON document.

`python -m tests.support.recordings NAME…` records the cases anew, and names those that have changed.
"""

import importlib
import json
import lzma
import sys
from functools import cache
from pathlib import Path
from typing import Any

DATA = Path(__file__).parents[1] / "data"


@cache
def read(name: str) -> dict[str, Any]:
    """Return the recorded documents of all cases."""
    recorded: dict[str, Any] = json.loads(lzma.decompress((DATA / f"{name}.json.xz").read_bytes()))
    return recorded


def record(name: str) -> None:
    """Record the cases of `tests.support.NAME`, whose `documents()` yields (case, document)."""
    path = DATA / f"{name}.json.xz"
    before = read(name) if path.exists() else {}
    documents = dict(importlib.import_module(f"tests.support.{name}").documents())
    for case in before.keys() | documents.keys():
        if before.get(case) != documents.get(case):
            print(f"{name}: {case} has changed")
    text = json.dumps(documents, sort_keys=True, separators=(",", ":"))
    path.write_bytes(lzma.compress(text.encode(), preset=9))


if __name__ == "__main__":
    for recording in sys.argv[1:]:
        record(recording)
