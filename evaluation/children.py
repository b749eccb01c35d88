"""Processes that a studio starts for its work: they give way to whoever serves, and end with their studio.

A child is `python -m MODULE ARGUMENT`. Its standard input is its studio's life: it ends when that closes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

ASIDE = 19
"""The niceness of children: a replica that has something to answer goes first."""
SOON = 5
"""That of children for which somebody waits: they go before the others."""


def start(module: str, argument: str, *, answers: bool = False) -> subprocess.Popen[bytes]:
    """A process that finds the modules that this one finds. Its standard input is open as long as this one lives.

    answers: its standard output is a pipe, too.
    """
    paths = os.pathsep.join(path for path in sys.path if path)
    return subprocess.Popen(
        [sys.executable, "-m", module, argument],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE if answers else None,
        env=os.environ | {"PYTHONPATH": paths},
        start_new_session=True,  # Ctrl-C is for the server, which ends it
    )


def bury(process: subprocess.Popen[bytes]) -> int:
    """Wait for the end of a child that has ended, or was killed; returns its exit code."""
    code = process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(BrokenPipeError):  # what it did not take any more
                pipe.close()
    return code


def step_aside(niceness: int = ASIDE) -> None:
    """Called by a child: let others go first."""
    os.nice(niceness)


def end_with_studio(last: Callable[[], None] = lambda: None) -> None:
    """Called by a child: do `last` and end at once when the process that started this one is gone."""

    def watch() -> None:
        # Not by `sys.stdin`: Python aborts when it ends while a thread holds the lock of a buffer.
        while os.read(0, 1024):
            pass
        try:
            last()
        finally:
            os._exit(1)

    threading.Thread(target=watch, name="studio", daemon=True).start()
