"""Follows the registry's aliases, drives the live slots, and tells the registry what this replica serves.

One task on the event loop; the database is asked in a thread of its own, so that a database that hangs holds up nothing
but this.
"""

import asyncio
import logging
import random
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import TypeVar

from league.errors import LeagueError
from league.registry.registry import Registry
from serve_app.live import Live
from serve_app.settings import ServeSettings

logger = logging.getLogger("ray.serve.policy_league")
JITTER = 0.1
"""Share of a pause that varies, so that replicas do not ask all at once."""
GOODBYE = 5.0
"""Seconds that shutting down may wait for the database."""

T = TypeVar("T")
Said = tuple[int | None, str | None, str | None]
"""version, sha256, fault"""


class AliasWatcher:
    """Keeps `live` at the registry's aliases and acknowledges it as `replica`."""

    def __init__(self, registry: Registry, live: Live, replica: str, settings: ServeSettings) -> None:
        self._registry = registry
        self._live = live
        self._replica = replica
        self._settings = settings
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="aliases")
        self._random = random.Random()
        self._first_look = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._pause = settings.poll
        self._said: dict[str, Said] = {}
        self._said_at = -settings.heartbeat

    @property
    def is_ready(self) -> bool:
        """Whether the aliases were seen once and are still followed."""
        return self._first_look.is_set() and self._task is not None and not self._task.done()

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Follow the aliases while the context lasts, which begins when they were seen once."""
        self._task = asyncio.create_task(self._watch())
        try:
            await self._first_look.wait()
            yield
        finally:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task
            with suppress(LeagueError, TimeoutError):
                await asyncio.wait_for(self._call(partial(self._registry.forget, self._replica)), GOODBYE)
            self._thread.shutdown(wait=False, cancel_futures=True)

    async def _watch(self) -> None:
        while True:
            try:
                await self.look()
            except Exception as error:
                self._back_off(error)
            else:
                self._recover()
            await asyncio.sleep(self._pause * self._random.uniform(1 - JITTER, 1 + JITTER))

    async def look(self) -> None:
        """Look at the aliases once: swap what moved, then say so. Raises StorageError."""
        await self._live.follow(await self._call(self._registry.all_aliases))
        self._first_look.set()
        await self._acknowledge()

    async def _acknowledge(self) -> None:
        """Say at once what changed, and everything at each heartbeat."""
        serving = {league: self._serves(league) for league in self._live.leagues()}
        is_due = time.monotonic() - self._said_at >= self._settings.heartbeat
        news = {league: said for league, said in serving.items() if is_due or self._said.get(league) != said}
        for league, said in news.items():
            await self._call(partial(self._registry.acknowledge, self._replica, league, *said))
            self._said[league] = said
        if is_due:
            self._said_at = time.monotonic()

    def _serves(self, league: str) -> Said:
        champion = self._live.champion(league)
        number, sha256 = (champion.number, champion.sha256) if champion else (None, None)
        return number, sha256, self._live.fault(league)

    def _back_off(self, error: Exception) -> None:
        """Look less often. Only a bug raises something else than a LeagueError; it must not end the watching."""
        bug = None if isinstance(error, LeagueError) else error
        if self._pause <= self._settings.poll:
            logger.error("the aliases cannot be followed, what is live stays: %s", error, exc_info=bug)
        self._pause = min(2 * self._pause, self._settings.poll_slowest)

    def _recover(self) -> None:
        if self._pause > self._settings.poll:
            logger.error("the aliases are followed again")
        self._pause = self._settings.poll

    async def _call(self, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)
