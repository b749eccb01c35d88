"""Looks at something of the registry again and again, less often while that fails."""

import asyncio
import logging
import random
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress

from league.errors import LeagueError
from serve_app.settings import ServeSettings

logger = logging.getLogger("ray.serve.policy_league")
JITTER = 0.1
"""Share of a pause that varies, so that replicas do not ask all at once."""


class Polling:
    """Calls `look` as a task on the event loop. `subject` says in the log what cannot be followed: `the aliases`."""

    def __init__(self, look: Callable[[], Awaitable[None]], subject: str, settings: ServeSettings) -> None:
        self._look = look
        self._subject = subject
        self._settings = settings
        self._random = random.Random()
        self._has_seen = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._pause = settings.poll
        self._fault: str | None = None
        """The last one that was told; None while there is none."""

    @property
    def is_ready(self) -> bool:
        """Whether there was something to see once, and looking goes on."""
        return self._has_seen.is_set() and self._task is not None and not self._task.done()

    def saw(self) -> None:
        """Said by a look as soon as it has seen what there is, for what it does then may fail."""
        self._has_seen.set()

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Look while the context lasts, which begins when there was something to see."""
        self._task = asyncio.create_task(self._run())
        try:
            await self._has_seen.wait()
            yield
        finally:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task

    async def _run(self) -> None:
        while True:
            try:
                await self._look()
            except Exception as error:
                self._back_off(error)
            else:
                self._recover()
            await asyncio.sleep(self._pause * self._random.uniform(1 - JITTER, 1 + JITTER))

    def _back_off(self, error: Exception) -> None:
        """Look less often. Only a bug raises something else than a LeagueError; it must not end the looking."""
        bug = None if isinstance(error, LeagueError) else error
        if str(error) != self._fault:
            logger.error("%s cannot be followed, what is known stays: %s", self._subject, error, exc_info=bug)
        self._fault = str(error)
        self._pause = min(2 * self._pause, self._settings.poll_slowest)

    def _recover(self) -> None:
        if self._fault is not None:
            logger.error("%s are followed again", self._subject)
        self._fault = None
        self._pause = self._settings.poll
