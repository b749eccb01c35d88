"""The time that an examination may take, and its progress."""

import time
from collections.abc import Callable

REPORT_EVERY = 0.5
"""Least seconds between two reports of the progress."""


class TimeBudget:
    """Counts the time since its creation."""

    def __init__(self, seconds: float | None = None, progress: Callable[[str], None] | None = None) -> None:
        """seconds: None for no limit. progress: receives what is done, at most twice per second."""
        self.seconds, self._progress = seconds, progress
        self._began = time.monotonic()
        self._reported = self._began
        self.skipped: list[str] = []
        """What was left out, or done in part, because the time was spent."""

    def is_spent(self, share: float = 1.0, ahead: float = 0.0) -> bool:
        """Return whether this share of the time is over, or will be in `ahead` seconds."""
        return self.seconds is not None and time.monotonic() - self._began + ahead >= share * self.seconds

    def report(self, doing: str) -> None:
        """Report what is done now."""
        if self._progress is not None and (current_time := time.monotonic()) - self._reported >= REPORT_EVERY:
            self._reported = current_time
            self._progress(doing)
