"""Keeps the snapshots of all leagues up to date with a low-priority subprocess."""

from __future__ import annotations

import logging
import threading
import time

from league.errors import LeagueError
from league.registry.registry import Registry
from league.subprocesses import RequestProcess

logger = logging.getLogger("ray.serve.policy_league")
POLL_INTERVAL = 2.0
"""Minimum seconds between two checks for changes."""
IDLE_FACTOR = 9
"""Idle time as a multiple of working time, which limits the load to a tenth of a core."""
RETRY_DELAY = 60.0
"""Seconds until a league is retried after its snapshots could not be computed."""


class SnapshotRefresher(threading.Thread):
    """Polls the registry in a thread and recomputes stale snapshots, the league that waited longest first."""

    def __init__(self, registry: Registry) -> None:
        super().__init__(name="snapshot-refresher", daemon=True)
        self._registry = registry
        self._not_before: dict[str, float] = {}
        """league → monotonic time of the next attempt, for leagues whose snapshots could not be computed"""
        self._process = RequestProcess("evaluation.service.snapshots", work="computes the snapshots")
        self._is_closed = threading.Event()

    def close(self) -> None:
        """Stop polling and kill the subprocess. Unwritten snapshots are computed another time."""
        self._is_closed.set()
        self._process.close()
        self.join()

    def run(self) -> None:
        """Poll until `close`."""
        worked = 0.0
        while not self._is_closed.wait(max(POLL_INTERVAL, IDLE_FACTOR * worked)):
            began = time.monotonic()
            try:
                stale = self._registry.snapshots.stale()  # the longest first
                league = next((name for name in stale if began >= self._not_before.get(name, began)), None)
                if league is not None:
                    self._refresh(league)
            except LeagueError as error:
                logger.error("snapshots cannot be refreshed: %s", error)
            worked = time.monotonic() - began

    def _refresh(self, league: str) -> None:
        try:
            self._process.request(league)
        except LeagueError as error:
            if not self._is_closed.is_set():
                logger.error("computing the snapshots of league %s failed: %s", league, error)
                self._not_before[league] = time.monotonic() + RETRY_DELAY
