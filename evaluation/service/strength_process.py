"""The process that measures the strength of versions, as seen from the process that trains them."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime

from league.errors import WorkerLost, from_document
from league.registry.storage.rows import StrengthRow, VersionRow
from league.settings import Storage
from league.subprocesses import Subprocess


class StrengthProcess:
    """Starts with the first measurement, and again after it has died. One call at a time."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._process: Subprocess | None = None
        self._is_closed = False
        self._lock = threading.Lock()

    def __call__(self, version: VersionRow, games: int) -> list[StrengthRow]:
        """Play the matches of a version, `games` games per opponent, and return one row per opponent.

        Raises WorkerLost if the process died, and the LeagueError that it reports.
        """
        process = self._started(version.league)
        try:
            process.stdin.write(json.dumps({"version": version.number, "games": games}).encode() + b"\n")
            process.stdin.flush()
            response = json.loads(process.stdout.readline())
        except (OSError, ValueError) as error:
            self._stop()
            raise WorkerLost("the process that plays the matches died: see its messages above") from error
        if isinstance(response, dict):
            raise from_document(response)
        return [StrengthRow(**row | {"at": datetime.fromisoformat(row["at"])}) for row in response]

    def close(self) -> None:
        """End the process, also during a measurement."""
        self._is_closed = True
        self._stop()

    def _started(self, league: str) -> Subprocess:
        with self._lock:
            if self._is_closed:
                raise WorkerLost("the process that plays the matches was ended")
            if self._process is None:
                module, settings = "evaluation.service.strength_worker", self._storage.environment
                self._process = Subprocess(module, league, settings, output=True)
            return self._process

    def _stop(self) -> None:
        with self._lock:
            process, self._process = self._process, None
        if process is not None:
            process.stop()


@contextmanager
def strength_process(storage: Storage) -> Iterator[StrengthProcess]:
    """Return a process that ends with the block."""
    process = StrengthProcess(storage)
    try:
        yield process
    finally:
        process.close()
