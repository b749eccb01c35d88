"""Resolves the model and version of a request to the policy that answers it."""

import asyncio
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

from league.errors import NotReady, UnknownAlias, VersionRetired
from league.refs import CHAMPION, CheckpointRef, PolicyRef, parse_version
from league.registry.registry import Registry
from league.registry.storage.database import before
from serve_app.live_versions.alias_slots import AliasSlots
from serve_app.live_versions.policies import LoadedPolicy, LoadedVersion
from serve_app.live_versions.traffic_split import Headers, TrafficSplit, acting
from serve_app.live_versions.version_cache import VersionCache

T = TypeVar("T")

# Requests repeat the same few names.
policy_ref = lru_cache(maxsize=1024)(PolicyRef.parse)
version_of = lru_cache(maxsize=1024)(parse_version)


class ModelResolver:
    """Resolves models from alias slots, then the version cache, then the registry."""

    def __init__(self, registry: Registry, slots: AliasSlots, versions: VersionCache, traffic: TrafficSplit) -> None:
        self._registry = registry
        self._slots = slots
        self._traffic = traffic
        self._versions = versions
        self._threads = ThreadPoolExecutor(max_workers=4, thread_name_prefix="registry")
        self._changes = ThreadPoolExecutor(max_workers=2, thread_name_prefix="changes")

    async def find(self, model: str, version: str = CHAMPION, headers: Headers = ()) -> LoadedPolicy:
        """The policy of `model` (`{league}` or `{league}.{policy}`) at `version`, a number or an alias.

        headers: those of the request; the caller's key may route a request for the champion to the canary, and selects
        the member of a mixture. Raises
        InvalidReference, UnknownLeague, UnknownVersion, VersionRetired, UnknownAlias, UnknownPolicy, ArtifactCorrupt or
        StorageError; NotReady for a league without a champion.
        """
        if (loaded := self.find_loaded(model, version, headers)) is not None:
            return loaded
        ref, requested = policy_ref(model), version_of(version)
        if isinstance(requested, int):
            return self._acting(await self._versions.get(ref.league, requested), ref, headers)
        return self._acting(await self._resolve(ref.league, requested), ref, headers, requested == CHAMPION)

    def find_loaded(self, model: str, version: str = CHAMPION, headers: Headers = ()) -> LoadedPolicy | None:
        """Like `find`, but None if the version is not in memory."""
        ref, requested = policy_ref(model), version_of(version)
        if isinstance(requested, int):
            loaded = self._versions.cached(ref.league, requested)
        else:
            loaded = self._slots.get(ref.league, requested)
        return None if loaded is None else self._acting(loaded, ref, headers, requested == CHAMPION)

    def _acting(
        self, version: LoadedVersion, ref: PolicyRef, headers: Headers, is_champion: bool = False
    ) -> LoadedPolicy:
        if is_champion and self._traffic.canaries:
            version = self._traffic.route(version, headers)
        if version.mixture is not None:
            version = acting(version, headers)
        return version.policy(ref.policy)

    async def members(self, model: str, version: str) -> Collection[int]:
        """The members of a mixture that is named by its number; none of another version or an alias.

        Raises the errors of `find`.
        """
        ref, requested = policy_ref(model), version_of(version)
        if not isinstance(requested, int):
            return ()
        loaded = self._versions.cached(ref.league, requested) or await self._versions.get(ref.league, requested)
        return [member.number for member in loaded.members]

    async def in_registry_thread(self, function: Callable[[Registry], T]) -> T:
        """Call `function` with the registry in one of its threads."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, self._registry)

    async def in_change_thread(self, function: Callable[[Registry], T], deadline: float) -> T:
        """Change the registry in a thread for changes, unless `deadline` (of `time.monotonic`) passes before.

        Changes wait for locks, so they have threads of their own. Raises DeadlineExceeded.
        """

        def apply() -> T:
            with before(deadline):
                return function(self._registry)

        return await asyncio.get_running_loop().run_in_executor(self._changes, apply)

    def close(self) -> None:
        """Stop the threads."""
        for threads in (self._threads, self._changes):
            threads.shutdown(wait=False, cancel_futures=True)

    async def _resolve(self, league: str, alias: str) -> LoadedVersion:
        """Resolve an alias without a slot: unknown, created since the last poll, or impossible to load."""
        try:
            row = await self.in_registry_thread(
                lambda registry: registry.versions.resolve(CheckpointRef(league, alias))
            )
        except UnknownAlias as error:
            if alias != CHAMPION:
                raise
            raise NotReady(f"league {league} has no champion: promote a version first") from error
        try:
            return await self._versions.get(league, row.number)
        except VersionRetired as error:
            raise NotReady(f"{league}@{alias} names a retired version: {row.number}") from error
