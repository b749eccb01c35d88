"""The measurements of the object store run, and no killed publisher leaves a partial version."""

import subprocess
import sys

import pytest


@pytest.mark.slow
def test_the_quick_form_finds_no_partial_version_and_few_bytes() -> None:
    command = [sys.executable, "-m", "benchmarks", "object_store", "--quick"]
    process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=200)
    lines = dict(line.partition(": ")[::2] for line in process.stdout.splitlines())
    assert lines["partial versions visible"].startswith("0 "), process.stderr
    assert float(lines["received for a version of 1 MB"].split()[0]) <= 2
