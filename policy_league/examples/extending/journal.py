"""A tracker that writes what happens in a run to a file in the run's directory."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from training.runs.run_directory import RunDirectory


class Journal:
    """One line of JSON for each report."""

    def __init__(self, run: RunDirectory) -> None:
        self._file = run.path / "journal.jsonl"

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Write curves."""
        self._write(step=step, curves=dict(values))

    def add(self, ref: str, files: Path, about: Mapping[str, Any]) -> None:
        """Write a version, and the names of its files."""
        self._write(version=ref, files=sorted(path.name for path in files.iterdir()), about=dict(about))

    def end(self, state: str) -> None:
        """Write how the run ended."""
        self._write(state=state)

    def _write(self, **entry: Any) -> None:
        with self._file.open("a") as file:
            file.write(json.dumps(entry) + "\n")
