"""Processes of our own that are started for one thing, find the modules that this one finds, and end when it does."""

from __future__ import annotations

import os
import subprocess
import sys


def start(module: str, argument: str, *, answers: bool = False) -> subprocess.Popen[bytes]:
    """`python -m module argument`. Its standard input is open as long as this process lives.

    answers: read its standard output, too.
    """
    paths = os.pathsep.join(path for path in sys.path if path)
    return subprocess.Popen(
        [sys.executable, "-m", module, argument],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE if answers else None,
        env=os.environ | {"PYTHONPATH": paths},
        start_new_session=True,  # Ctrl-C is for the server, which ends it
    )
