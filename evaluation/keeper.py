"""Keeps the snapshots of all leagues fresh: one process at a time, at the lowest priority, with long pauses between."""

from __future__ import annotations

import logging
import threading
import time

from evaluation import children
from league.errors import LeagueError
from league.registry.registry import Registry

logger = logging.getLogger("ray.serve.policy_league")
LOOK = 2.0
"""Seconds between two looks at what has changed, at least."""
WATCH = 0.1
"""Seconds between two looks at whether a process has ended."""
REST = 9
"""How many times as long as it has worked it rests: it takes a tenth of a core at most."""
RETRY = 60.0
"""Seconds until a league is tried again whose process failed."""


class Keeper:
    """Watches the registry in a thread, and has whatever league has changed computed anew, the longest unseen first."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._not_before: dict[str, float] = {}
        """league → when it may be tried again, of those whose process failed"""
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="keeper", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    @property
    def is_watching(self) -> bool:
        """Whether it looks."""
        return self._thread.is_alive()

    def close(self) -> None:
        """End, with the process that is at work: what it has not written is computed another time."""
        self._is_over.set()
        self._thread.join()

    def _run(self) -> None:
        worked = 0.0
        while not self._is_over.wait(max(LOOK, REST * worked)):
            began = time.monotonic()
            try:
                if (league := self._stale()) is not None:
                    self._refresh(league)
            except LeagueError as error:
                logger.error("snapshots cannot be kept: %s", error)
            worked = time.monotonic() - began

    def _stale(self) -> str | None:
        """The league that has waited longest of those whose snapshots are not up to date."""
        now = time.monotonic()
        waiting = (league for league in self._registry.stale_snapshots() if now >= self._not_before.get(league, now))
        return next(waiting, None)

    def _refresh(self, league: str) -> None:
        process = children.start("evaluation.snapshots", league)
        while process.poll() is None and not self._is_over.wait(WATCH):
            pass
        process.kill()
        if children.bury(process) and not self._is_over.is_set():
            logger.error("the process that computes the snapshots of league %s failed", league)
            self._not_before[league] = time.monotonic() + RETRY
