"""Runs the `league` command, in this process or in a new one."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from click.testing import CliRunner

from policy_league.cli import output
from policy_league.cli.main import run

WIDTH = 200
"""Terminal columns: wide enough that no table row is wrapped."""
# A console reads the width from the environment once, when it is created.
output.console.width = output.errors.width = WIDTH

COMMAND = (sys.executable, "-c", "from policy_league.cli.main import run; run()")


@dataclass(frozen=True)
class Result:
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


League = Callable[..., Result]


def environment(home: Path) -> dict[str, str]:
    return {"LEAGUE_HOME": str(home), "COLUMNS": str(WIDTH), "NO_COLOR": "1"}


def in_process(home: Path, *arguments: str, stdin: str | None = None) -> Result:
    """Run the command in this process. Re-raises exceptions other than SystemExit: a user would see a traceback."""
    isolated = CliRunner().isolation(stdin)
    with mock.patch.dict(os.environ, environment(home)), _restore("argv", "path"), isolated as (out, err, _):
        sys.argv = ["league", *arguments]
        try:
            run()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        sys.stdout.flush()
        sys.stderr.flush()
        return Result(code, out.getvalue().decode(), err.getvalue().decode())


def in_subprocess(home: Path, *arguments: str, stdin: str | None = None, timeout: float = 120) -> Result:
    """Run the command in a subprocess."""
    done = subprocess.run(
        [*COMMAND, *arguments],
        env=os.environ | environment(home),
        input=stdin,
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    return Result(done.returncode, done.stdout, done.stderr)


@contextmanager
def _restore(*names: str) -> Iterator[None]:
    """Restore the lists of `sys` with these names when the context ends."""
    saved = {name: list(getattr(sys, name)) for name in names}
    try:
        yield
    finally:
        for name, value in saved.items():
            setattr(sys, name, value)
