"""The time that an examination may take, and its progress."""

import time
from collections.abc import Callable


class TimeBudget:
    """Counts the time since its creation.

    Attributes:
        seconds: The limit; None for none.
        report: Receives what is done now.
        skipped: What was left out, or done in part, because the time was spent.
    """

    def __init__(self, seconds: float | None = None, report: Callable[[str], None] = lambda _: None) -> None:
        self.seconds, self.report = seconds, report
        self._began = time.monotonic()
        self.skipped: list[str] = []

    def is_spent(self, share: float = 1.0, ahead: float = 0.0) -> bool:
        """Return whether this share of the time is over, or will be in `ahead` seconds."""
        return self.seconds is not None and time.monotonic() - self._began + ahead >= share * self.seconds
