"""A subprocess that answers requests: `python -m tests.support.answering DIRECTORY`.

It creates `began` in the directory when a request that never ends has begun, and `ended` at its own end.
"""

import sys
from pathlib import Path
from threading import Event

from league.subprocesses import answer_requests


def main() -> None:
    directory = Path(sys.argv[1])

    def respond(line: bytes) -> tuple[dict[str, int], bytes]:
        if line == b"wait\n":
            (directory / "began").touch()
            Event().wait()
        return {"length": len(line)}, b""

    answer_requests(respond, (directory / "ended").touch)


if __name__ == "__main__":
    main()
