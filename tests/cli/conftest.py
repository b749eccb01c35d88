import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from league.registry.registry import Registry
from tests.evaluation import examples


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


League = Callable[..., Outcome]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "home"


@pytest.fixture
def registry(home: Path) -> Registry:
    """Three versions of tic-tac-toe: one that sees nothing, one that blocks, one that wins and blocks."""
    registry = examples.registry(home)
    for graph in (examples.graph(), examples.graph(blocks=True), examples.graph(wins=True, blocks=True)):
        examples.publish(registry, graph)
    return registry


@pytest.fixture
def league(home: Path) -> League:
    """Run the command as a person does, in a process of its own."""

    def run(*arguments: str, stdin: str | None = None, timeout: float = 120) -> Outcome:
        done = subprocess.run(
            [sys.executable, "-c", "from cli.main import run; run()", *arguments],
            env=os.environ | {"LEAGUE_HOME": str(home), "COLUMNS": "200", "NO_COLOR": "1"},
            input=stdin,
            capture_output=True,
            text=True,
            timeout=timeout,
        )
        return Outcome(done.returncode, done.stdout, done.stderr)

    return run
