"""What Ctrl-C does to commands that can be continued."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from policy_league.cli.output import say

INTERRUPTED = 130
"""Exit code of a process ended by SIGINT: 128 + 2."""


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Turn Ctrl-C into a message and exit code 130. Without a message the process exits at once."""
    try:
        yield
    except KeyboardInterrupt as end:
        if not str(end):
            # Python would end a publishing thread by force, which Ray's handlers report as a crash. --resume publishes
            # the version.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(INTERRUPTED)
        say(f"\n{end}")
        raise typer.Exit(INTERRUPTED) from end
