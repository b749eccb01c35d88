"""Keeps the snapshots of all leagues up to date with one low-priority subprocess at a time."""

from __future__ import annotations

import logging
import threading
import time

from league.errors import LeagueError
from league.registry.registry import Registry
from league.subprocesses import Subprocess

logger = logging.getLogger("ray.serve.policy_league")
POLL_INTERVAL = 2.0
"""Minimum seconds between two checks for changes."""
IDLE_FACTOR = 9
"""Idle time as a multiple of working time, which limits the load to a tenth of a core."""
RETRY_DELAY = 60.0
"""Seconds until a league is retried after its subprocess failed."""


class SnapshotRefresher:
    """Polls the registry in a thread and recomputes stale snapshots, the league that waited longest first."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._not_before: dict[str, float] = {}
        """league → monotonic time of the next attempt, for leagues whose subprocess failed"""
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="snapshot-refresher", daemon=True)

    def start(self) -> None:
        """Start polling."""
        self._thread.start()

    @property
    def is_running(self) -> bool:
        """Whether the polling thread is alive."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Stop polling and kill the current subprocess. Unwritten snapshots are computed another time."""
        self._is_closed.set()
        self._thread.join()

    def _run(self) -> None:
        worked = 0.0
        while not self._is_closed.wait(max(POLL_INTERVAL, IDLE_FACTOR * worked)):
            began = time.monotonic()
            try:
                stale = self._registry.snapshots.stale()  # the longest first
                league = next((name for name in stale if began >= self._not_before.get(name, began)), None)
                if league is not None:
                    process = Subprocess("evaluation.service.snapshots", league)
                    process.wait(self._is_closed)
                    if process.stop() and not self._is_closed.is_set():
                        logger.error("the subprocess that computes the snapshots of league %s failed", league)
                        self._not_before[league] = time.monotonic() + RETRY_DELAY
            except LeagueError as error:
                logger.error("snapshots cannot be refreshed: %s", error)
            worked = time.monotonic() - began
