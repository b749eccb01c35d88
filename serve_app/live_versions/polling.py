"""Polls the registry with exponential backoff."""

import asyncio
import random
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

from league.errors import LeagueError
from serve_app.runtime.background import in_background
from serve_app.runtime.ray_serve import logger

JITTER = 0.1
"""Relative variation of a pause, so that replicas do not poll at the same time."""

OVERDUE = 5.0
"""Seconds after which a poll that has not returned is logged."""


class Polling:
    """Calls `poll` in a task on the event loop.

    subject: names the polled data in log lines: `aliases`. interval, slowest: seconds between two polls, which are
    doubled up to `slowest`, unless the interval is longer, while polls fail. pause: waits for a number of seconds, or
    until there is a reason to poll again.
    """

    def __init__(
        self,
        poll: Callable[[], Awaitable[None]],
        subject: str,
        interval: float,
        slowest: float,
        pause: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        self._poll = poll
        self._wait = pause
        self._subject = subject
        self._interval = interval
        self._slowest = max(interval, slowest)
        self._random = random.Random()
        self._has_seen = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._pause = interval
        self._fault: str | None = None
        """The last error that was logged; None after a success."""

    @property
    def is_ready(self) -> bool:
        """Whether a poll has succeeded and the task is running."""
        return self._has_seen.is_set() and self._task is not None and not self._task.done()

    def mark_ready(self) -> None:
        """Called by `poll` as soon as it has read the data, because later steps may fail."""
        self._has_seen.set()

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Poll while the context is active; enters after the first `mark_ready`."""
        async with in_background(self._run()) as self._task:
            await self._has_seen.wait()
            yield

    async def _run(self) -> None:
        while True:
            overdue = asyncio.get_running_loop().call_later(OVERDUE, self._report_overdue)
            try:
                await self._poll()
            except Exception as error:
                # Only a bug raises anything but a LeagueError; it must not stop polling.
                bug = None if isinstance(error, LeagueError) else error
                if str(error) != self._fault:
                    logger.error("cannot poll %s, keeping the last known state: %s", self._subject, error, exc_info=bug)
                self._fault = str(error)
                self._pause = min(2 * self._pause, self._slowest)
            else:
                if self._fault is not None:
                    logger.error("polling %s again", self._subject)
                self._fault = None
                self._pause = self._interval
            finally:
                overdue.cancel()
            await self._wait(self._pause * self._random.uniform(1 - JITTER, 1 + JITTER))

    def _report_overdue(self) -> None:
        """Log that a poll does not return: until the database answers or a timeout ends it, nothing is followed."""
        self._fault = f"a poll has not returned for {OVERDUE:g} s"
        logger.error("cannot poll %s, keeping the last known state: %s", self._subject, self._fault)
