"""Compare answers with the recorded ones, or record them anew: `python -m tests.support.corpus [--write]`."""

import json
import lzma
import sys
import tempfile
from pathlib import Path
from typing import Any

from league.settings import Storage
from tests.support.corpus import FEW, MANY, RECORDED, read
from tests.support.corpus.answers import alike, rounds, sides


def main() -> None:
    recorded: dict[str, dict[str, Any]] = {} if "--write" in sys.argv else read()
    different = 0
    with tempfile.TemporaryDirectory() as scratch:
        storages = [Storage.at(Path(scratch) / name) for name in ("without", "with")]
        with sides(storages) as replicas:
            for interface, digest, answers in rounds(replicas, (FEW, MANY)):
                expected = recorded.setdefault(interface, {}).setdefault(digest, answers[-1])
                for answer in answers:
                    if not alike(answer, expected):
                        different += 1
                        print(interface, digest, *(f"\n  {json.dumps(one)[:2000]}" for one in (expected, answer)))
    print(f"{sum(map(len, recorded.values()))} answers, {different} different")
    if "--write" in sys.argv and not different:
        text = json.dumps(recorded, sort_keys=True, separators=(",", ":"))
        RECORDED.write_bytes(lzma.compress(text.encode(), preset=9))
    sys.exit(different > 0)


main()
