"""Follows the registry's aliases and traffic settings, and acknowledges what this replica serves.

One task on the event loop. The database is queried in a thread of its own, so that a query that hangs delays nothing
else.
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
from league.registry.replicas import LIVENESS_TIMEOUT
from league.registry.storage.rows import AliasTarget
from league.registry.storage.rows import Traffic as Setting
from serve_app.models.alias_slots import Alias, AliasSlots
from serve_app.models.polling import Polling
from serve_app.models.traffic_split import TrafficSplit, pinned_slots
from serve_app.runtime.ray_serve import logger
from serve_app.runtime.replica_process import ReplicaProcess
from serve_app.settings import ServeSettings

SHUTDOWN_TIMEOUT = 5.0
"""Seconds to wait for the database during shutdown."""

T = TypeVar("T")


class _Acknowledged(NamedTuple):
    """The acknowledgement of a league."""

    version: int | None
    sha256: str | None
    fault: str | None
    aliases: Mapping[str, int]
    traffic: int | None
    event: int | None


class AliasWatcher:
    """Keeps `slots` at the registry's aliases and `traffic` at its settings, and acknowledges both as `replica`."""

    def __init__(
        self,
        registry: Registry,
        slots: AliasSlots,
        traffic: TrafficSplit,
        replica: str,
        process: ReplicaProcess,
        settings: ServeSettings,
    ) -> None:
        self._registry = registry
        self._process = process
        self._slots = slots
        self._traffic = traffic
        self._replica = replica
        self._settings = settings
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="aliases")
        self._polling = Polling(self.poll_once, "aliases", settings)
        self._events: dict[str, int] = {}
        """league → the newest alias event that was read"""
        self._acknowledged: dict[str, _Acknowledged] = {}
        self._acknowledged_at = -settings.heartbeat

    @property
    def is_ready(self) -> bool:
        """Whether the aliases were read at least once and are still polled."""
        return self._polling.is_ready

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Poll while the context is active; enters after the first successful poll."""
        try:
            async with self._polling.running():
                yield
        finally:
            self._slots.close()
            with suppress(LeagueError, TimeoutError):
                await asyncio.wait_for(
                    self._call(partial(self._registry.replicas.remove, self._replica)), SHUTDOWN_TIMEOUT
                )
            self._thread.shutdown(wait=False, cancel_futures=True)

    async def poll_once(self) -> None:
        """Read the aliases once, start to load what they name, and acknowledge. Raises StorageError.

        A version that takes longer than a pause to load is acknowledged by a later call.
        """
        is_due = time.monotonic() - self._acknowledged_at >= self._settings.heartbeat
        if is_due:
            # Before the aliases are read for the first time: nobody waits for a replica that is not registered.
            await self._call(self._register)
        aliases, settings = await self._call(self._wanted)
        if not aliases and self._slots.leagues():
            raise StorageError("the registry has no aliases, but had some before: it is a different database")
        self._events = _newest_events(aliases)
        self._slots.update({alias: target.version for alias, target in aliases.items()} | pinned_slots(settings))
        await self._slots.settle(self._settings.poll)
        self._traffic.update(settings)
        if self._slots.is_settled:
            self._polling.mark_ready()
        await self._acknowledge(is_due)

    def _register(self) -> None:
        """Register this replica, and remove those that ended without deregistering."""
        self._registry.replicas.register(self._replica, self._process.description)
        for other in self._registry.replicas.registered():
            if other.silence > LIVENESS_TIMEOUT and self._process.has_ended(other.process):
                self._registry.replicas.remove(other.replica)
                logger.info("replica %s has ended without deregistering", other.replica)

    async def _acknowledge(self, is_due: bool) -> None:
        """Acknowledge changes at once, and everything at each heartbeat."""
        serving = {league: self._serves(league) for league in self._slots.leagues()}
        changed = {
            league: acknowledgement
            for league, acknowledgement in serving.items()
            if is_due or self._acknowledged.get(league) != acknowledgement
        }
        for league, acknowledgement in changed.items():
            await self._call(partial(self._registry.replicas.acknowledge, self._replica, league, *acknowledgement))
            self._acknowledged[league] = acknowledgement
        if is_due:
            self._acknowledged_at = time.monotonic()

    def _serves(self, league: str) -> _Acknowledged:
        champion = self._slots.champion(league)
        number, sha256 = (champion.number, champion.sha256) if champion else (None, None)
        followed = self._traffic.applied_setting(league)
        aliases, event = self._slots.numbers(league), self._events.get(league)
        return _Acknowledged(number, sha256, self._slots.fault(league), aliases, followed, event)

    def _wanted(self) -> tuple[dict[Alias, AliasTarget], dict[str, Setting]]:
        return self._registry.aliases.all(), self._registry.traffic.all()

    async def _call(self, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)


def _newest_events(aliases: Mapping[Alias, AliasTarget]) -> dict[str, int]:
    newest: dict[str, int] = {}
    for (league, _), target in aliases.items():
        newest[league] = max(target.event, newest.get(league, 0))
    return newest
