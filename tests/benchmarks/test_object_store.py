"""The measurements of the object store run, and no killed publisher leaves a partial version."""

import subprocess
import sys

import pytest


@pytest.mark.slow
def test_the_quick_form_finds_no_partial_version_and_few_bytes() -> None:
    command = [sys.executable, "-m", "benchmarks.object_store", "--quick"]
    process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=200)
    assert " 0 partial versions visible" in process.stdout, process.stderr
    (line,) = (line for line in process.stdout.splitlines() if line.startswith("bytes received"))
    assert float(line.partition("state: ")[2].split()[0]) <= 2
