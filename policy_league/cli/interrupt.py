"""What signals do to commands that can be continued."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from league.interruption import exit_code
from policy_league.cli.output import say


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Turn an interrupt into a message and the signal's exit code. Without a message the process exits at once."""
    try:
        yield
    except KeyboardInterrupt as end:
        if not str(end):
            # Python would end a publishing thread by force, which Ray's handlers report as a crash. --resume publishes
            # the version.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(exit_code())
        say(f"\n{end}")
        raise typer.Exit(exit_code()) from end
