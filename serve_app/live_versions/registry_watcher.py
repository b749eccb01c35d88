"""Follows the registry's aliases, traffic settings, API keys, action selections and removals of versions, and
acknowledges what this replica serves.

One task on the event loop. It reads what has changed, as the change counter tells: after a notification of PostgreSQL,
otherwise by polling.
"""

import asyncio
import random
import time
from collections.abc import AsyncIterator, Callable, Mapping, Set
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta

from league.conditions import ActionSelection
from league.errors import LeagueError, StorageError
from league.registry.registry import Registry
from league.registry.replicas import KEPT
from league.registry.storage.rows import AliasTarget, ChangeCounts, KeyRow, ReadPosition, ServedState, VersionState
from league.registry.storage.rows import Traffic as Setting
from serve_app.live_versions.alias_slots import Alias, AliasSlots
from serve_app.live_versions.policies import ActionSelections
from serve_app.live_versions.polling import JITTER, Polling
from serve_app.live_versions.registry_connection import SHUTDOWN_TIMEOUT, RegistryConnection
from serve_app.live_versions.traffic_split import TrafficSplit, pinned_slots
from serve_app.live_versions.version_cache import VersionKey
from serve_app.runtime.ray_serve import logger
from serve_app.runtime.replica_process import ReplicaProcess
from serve_app.settings import ServeSettings

POLL_NOTIFIED = 1.0
"""Seconds between polls where PostgreSQL notifies of changes: a notification may be lost, for example in a pooler."""
SPREAD = 0.02
"""Seconds over which replicas that were notified at the same moment read. Changes in this time are read together."""
OVERDUE_HEARTBEATS = 1.5
"""Heartbeats without a report after which it is examined whether the process of another replica has ended."""
MAX_EXAMINED = 20
"""Replicas that one examines at a heartbeat. After an interruption of the database, all others are overdue."""


@dataclass(frozen=True, slots=True)
class _Read:
    """What the registry requires of replicas. A part is None if it has not changed since the last time."""

    counts: ChangeCounts
    connection: int
    """Number of the connection that it was read through."""
    aliases: Mapping[Alias, AliasTarget] | None
    traffic: Mapping[str, Setting] | None
    keys: list[KeyRow] | None
    selections: Mapping[str, ActionSelection] | None
    versions: Mapping[VersionKey, VersionState | None] | None
    """The versions in memory: they may have been removed."""


@dataclass(slots=True)
class _Acknowledged:
    """What the registry knows of this replica."""

    position: ReadPosition | None = None
    differing: dict[str, ServedState] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class WatchedState:
    """What a replica keeps as the registry requires.

    update_keys: raises StorageError if the keys are those of a different database.
    """

    slots: AliasSlots
    traffic: TrafficSplit
    selections: ActionSelections
    update_keys: Callable[[list[KeyRow]], None]


class RegistryWatcher:
    """Keeps the state of a replica at what the registry requires, and acknowledges it as `replica`.

    on_heartbeat: called at each heartbeat, in the thread of the connection. on_replicas: called after each heartbeat
    with the number of replicas that are not being stopped.
    """

    def __init__(
        self,
        connection: RegistryConnection,
        state: WatchedState,
        replica: str,
        process: ReplicaProcess,
        settings: ServeSettings,
        on_heartbeat: Callable[[], None] = lambda: None,
        on_replicas: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._connection = connection
        self._state = state
        self._slots, self._traffic = state.slots, state.traffic
        self._replica = replica
        self._process = process
        self._settings = settings
        self._on_heartbeat = on_heartbeat
        self._on_replicas = on_replicas
        self._polling = Polling(self.poll_once, "the registry", settings.poll, settings.poll_slowest, self._pause)
        self._aliases: Mapping[Alias, AliasTarget] = {}
        self._wanted_traffic: Mapping[str, Setting] = {}
        self._position = ReadPosition(0, 0, 0)
        self._newest_events: Mapping[str, int] = {}
        """league → its newest alias event"""
        self._last_read: _Read | None = None
        self._heartbeat_at = 0.0
        """When the next one is due, a time of `time.monotonic`."""
        self._acknowledged = _Acknowledged()
        self._is_current = False
        """Whether the last poll succeeded and everything is served."""

    @property
    def is_ready(self) -> bool:
        """Whether everything was read at least once and is still polled."""
        return self._polling.is_ready

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Follow the registry while the context is active; enters after everything was read and loaded once."""
        try:
            async with self._polling.running():
                yield
        finally:
            self._slots.close()
            with suppress(LeagueError, TimeoutError):
                await asyncio.wait_for(
                    self._connection.call(lambda registry: registry.replicas.remove(self._replica)), SHUTDOWN_TIMEOUT
                )

    async def poll_once(self) -> None:
        """Read what has changed, start to load what it names, and acknowledge. Raises StorageError.

        A version that takes longer than a pause to load is acknowledged by a later call.
        """
        self._is_current = False
        if time.monotonic() >= self._heartbeat_at:
            # Before the aliases are read for the first time: nobody waits for a replica that is not registered.
            is_known, replicas = await self._connection.call(self._report_life)
            if not is_known:
                self._acknowledged = _Acknowledged()
            self._on_replicas(replicas)
            self._heartbeat_at = time.monotonic() + self._settings.heartbeat
        loaded = self._slots.loaded()
        read = await self._connection.call(lambda registry: self._read(registry, loaded))
        self._accept(read)
        if read.versions is not None:
            self._slots.drop_changed(read.versions)
        if read.aliases is not None or read.traffic is not None or self._slots.differing():
            alias_versions = {alias: target.version for alias, target in self._aliases.items()}
            self._slots.update(alias_versions | pinned_slots(self._wanted_traffic))
            await self._slots.settle(self._settings.poll)
            self._traffic.update(self._wanted_traffic)
        if self._slots.is_settled:
            self._polling.mark_ready()
        await self._acknowledge()
        self._is_current = not self._slots.differing()

    async def _pause(self, seconds: float) -> None:
        """Wait until the next poll: the next notification, unless a version must be loaded or the last poll failed."""
        longest = max(seconds, POLL_NOTIFIED * random.uniform(1 - JITTER, 1 + JITTER))
        timeout = max(0.0, min(longest, self._heartbeat_at - time.monotonic()))
        if not self._is_current or not await self._connection.wait(timeout):
            await asyncio.sleep(seconds)
        else:
            await asyncio.sleep(random.uniform(0, SPREAD))

    def _report_life(self, registry: Registry) -> tuple[bool, int]:
        """Register this replica, and remove those that ended without deregistering.

        Returns whether this one was registered, and the number of replicas that are not being stopped.
        """
        is_known = registry.replicas.register(self._replica, self._process.described(), self._process.is_draining())
        overdue = OVERDUE_HEARTBEATS * timedelta(seconds=self._settings.heartbeat)
        replicas = registry.replicas.counts(overdue)
        silent = registry.replicas.silent(overdue) if replicas.silent else []
        for other in random.sample(silent, min(len(silent), MAX_EXAMINED)):
            if other.silence > KEPT or self._process.has_ended(other.process):
                registry.replicas.remove(other.replica)
                logger.info("replica %s has ended without deregistering", other.replica)
        self._on_heartbeat()
        return is_known, replicas.registered - replicas.draining

    def _read(self, registry: Registry, loaded: Set[VersionKey]) -> _Read:
        """Read the parts that have changed, or all through a new connection: it may be a different database."""
        self._connection.discard_notifications()
        counts, connection = registry.changes.counts(), self._connection.opened
        last = self._last_read
        last_counts = last.counts if last is not None and connection == last.connection else None
        return _Read(
            counts,
            connection,
            registry.aliases.all() if last_counts is None or last_counts.aliases != counts.aliases else None,
            registry.traffic.all() if last_counts is None or last_counts.traffic != counts.traffic else None,
            registry.keys.all() if last_counts is None or last_counts.keys != counts.keys else None,
            registry.leagues.action_selections()
            if last_counts is None or last_counts.leagues != counts.leagues
            else None,
            registry.versions.states(loaded) if last_counts is None or last_counts.leagues != counts.leagues else None,
        )

    def _accept(self, read: _Read) -> None:
        """Take over what was read. Raises StorageError, and takes over nothing, if it is of a different database."""
        if read.aliases is not None and not read.aliases and self._aliases:
            raise StorageError("the registry has no aliases, but had some before: it is a different database")
        if read.keys is not None:
            self._state.update_keys(read.keys)
        if read.aliases is not None:
            self._aliases = read.aliases
            newest_events: dict[str, int] = {}
            for (league, _), target in read.aliases.items():
                newest_events[league] = max(target.event, newest_events.get(league, 0))
            self._newest_events = newest_events
        if read.traffic is not None:
            self._wanted_traffic = read.traffic
        if read.selections is not None:
            self._state.selections.update(read.selections)
        settings = (one.id or 0 for one in self._wanted_traffic.values())
        newest = max(self._newest_events.values(), default=0), max(settings, default=0)
        self._position = ReadPosition(read.counts.to_acknowledge, *newest)
        self._last_read = read

    async def _acknowledge(self) -> None:
        """Acknowledge what was read, and leagues that differ from it, if this has changed."""
        acknowledgement, position, differing = self._acknowledged, self._position, self._differing()
        changed = {
            league: state for league, state in differing.items() if acknowledgement.differing.get(league) != state
        }
        settled = None if acknowledgement.position is None else acknowledgement.differing.keys() - differing.keys()
        if position == acknowledgement.position and not changed and not settled:
            return
        self._acknowledged = _Acknowledged()  # unknown, until it is certain that the change was committed
        if await self._connection.call(
            lambda registry: registry.replicas.acknowledge(self._replica, position, changed, settled)
        ):
            self._acknowledged = _Acknowledged(position, differing)
        else:
            self._heartbeat_at = 0.0  # another replica took this one for dead: register again

    def _differing(self) -> dict[str, ServedState]:
        """league → what is served, where this differs from what was read."""
        numbers, faults, states = self._slots.numbers(), self._slots.faults(), {}
        for league in self._slots.differing() | self._traffic.differing():
            champion = self._slots.champion(league)
            states[league] = ServedState(
                version=champion.number if champion else None,
                sha256=champion.sha256 if champion else None,
                fault=faults.get(league),
                aliases=numbers.get(league, {}),
                event=self._newest_events.get(league),
                traffic=self._traffic.applied_setting(league),
            )
        return states
