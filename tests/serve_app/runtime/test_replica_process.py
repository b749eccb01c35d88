import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from serve_app.runtime import replica_process
from serve_app.runtime.replica_process import has_ended, this_process

DESCRIBE = """
import json, sys
from serve_app.runtime.replica_process import this_process
print(json.dumps(this_process().description), flush=True)
sys.stdin.read()
"""


@pytest.fixture
def other() -> Iterator[tuple[subprocess.Popen[str], dict[str, str]]]:
    """Another process, and its description."""
    process = subprocess.Popen(
        [sys.executable, "-c", DESCRIBE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    yield process, json.loads(process.stdout.readline())
    process.kill()
    process.communicate()


def test_a_process_that_runs_has_not_ended(other: tuple[subprocess.Popen[str], dict[str, str]]) -> None:
    process, description = other
    assert description["pid"] == str(process.pid)
    assert not has_ended(description)
    assert not has_ended(this_process().description)
    os.kill(process.pid, signal.SIGSTOP)
    assert not has_ended(description), "a stuck process may continue"


@pytest.mark.parametrize("reaped", [True, False])
def test_a_killed_process_has_ended(other: tuple[subprocess.Popen[str], dict[str, str]], reaped: bool) -> None:
    process, description = other
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | (0 if reaped else os.WNOWAIT))
    assert has_ended(description)


def test_another_process_with_the_same_id_is_recognised() -> None:
    here = this_process().description
    assert has_ended({**here, "start": str(int(here["start"]) + 1)})


def test_nothing_is_known_of_other_machines() -> None:
    here = this_process().description
    assert not has_ended({**here, "machine": "another/1", "start": "1"})
    assert not has_ended({})


def test_systems_without_proc_know_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    here = this_process()
    monkeypatch.setattr(replica_process, "PROC", tmp_path)
    assert this_process().description == {}
    assert not here.has_ended({**here.description, "start": "1"})
