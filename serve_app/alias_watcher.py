"""Follows the registry's aliases and traffic, drives the live slots, and tells the registry what this replica serves.

One task on the event loop; the database is asked in a thread of its own, so that a database that hangs holds up nothing
but this.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import NamedTuple, TypeVar

from league.errors import LeagueError, StorageError
from league.registry.registry import Registry
from league.registry.rows import Traffic as Setting
from serve_app.live import Alias, Live
from serve_app.polling import Polling
from serve_app.settings import ServeSettings
from serve_app.traffic import Traffic, pinned

GOODBYE = 5.0
"""Seconds that shutting down may wait for the database."""

T = TypeVar("T")


class Said(NamedTuple):
    """What the registry is told of a league."""

    version: int | None
    sha256: str | None
    fault: str | None
    aliases: Mapping[str, int]
    traffic: int | None


class AliasWatcher:
    """Keeps `live` at the registry's aliases, `traffic` at its settings, and acknowledges both as `replica`."""

    def __init__(self, registry: Registry, live: Live, traffic: Traffic, replica: str, settings: ServeSettings) -> None:
        self._registry = registry
        self._live = live
        self._traffic = traffic
        self._replica = replica
        self._settings = settings
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="aliases")
        self._polling = Polling(self.look, "the aliases", settings)
        self._said: dict[str, Said] = {}
        self._said_at = -settings.heartbeat

    @property
    def is_ready(self) -> bool:
        """Whether the aliases were seen once and are still followed."""
        return self._polling.is_ready

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Follow the aliases while the context lasts, which begins when they were seen once."""
        try:
            async with self._polling.running():
                yield
        finally:
            with suppress(LeagueError, TimeoutError):
                await asyncio.wait_for(self._call(partial(self._registry.forget, self._replica)), GOODBYE)
            self._thread.shutdown(wait=False, cancel_futures=True)

    async def look(self) -> None:
        """Look at the aliases once: swap what moved, then say so. Raises StorageError."""
        aliases, settings = await self._call(self._wanted)
        if not aliases and self._live.leagues():
            raise StorageError("the registry names no version any more: it is not the one that was there")
        await self._live.follow(aliases | pinned(settings))
        self._traffic.follow(settings)
        self._polling.saw()
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
        followed = self._traffic.followed(league)
        return Said(number, sha256, self._live.fault(league), self._live.numbers(league), followed)

    def _wanted(self) -> tuple[dict[Alias, int], dict[str, Setting]]:
        return self._registry.all_aliases(), self._registry.all_traffic()

    async def _call(self, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)
