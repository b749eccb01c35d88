"""From the model and version of a request to the policy that answers it."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

from league.errors import NotReady, UnknownAlias, VersionRetired
from league.refs import CHAMPION, CheckpointRef, PolicyRef, parse_version
from league.registry.registry import Registry
from serve_app.live import Live
from serve_app.loading import LoadedPolicy, LoadedVersion
from serve_app.versions import Versions

T = TypeVar("T")

# The same few names come with every request.
policy_ref = lru_cache(maxsize=1024)(PolicyRef.parse)
version_of = lru_cache(maxsize=1024)(parse_version)


class Models:
    """Finds what answers: in the live slots, else among the versions in memory, else in the registry."""

    def __init__(self, registry: Registry, live: Live, versions: Versions) -> None:
        self._registry = registry
        self._live = live
        self._versions = versions
        self._threads = ThreadPoolExecutor(max_workers=4, thread_name_prefix="registry")

    async def find(self, model: str, version: str = CHAMPION) -> tuple[LoadedVersion, LoadedPolicy]:
        """What `model` (`{league}` or `{league}.{policy}`) is at `version`, a number or an alias.

        Raises InvalidReference, UnknownLeague, UnknownVersion, VersionRetired, UnknownAlias, UnknownPolicy,
        ArtifactCorrupt or StorageError; NotReady for a league without a champion.
        """
        ref, asked = policy_ref(model), version_of(version)
        if isinstance(asked, int):
            loaded = self._versions.held(ref.league, asked) or await self._versions.get(ref.league, asked)
        else:
            loaded = self._live.get(ref.league, asked) or await self._resolve(ref.league, asked)
        return loaded, loaded.policy(ref.policy)

    async def ask(self, question: Callable[[Registry], T]) -> T:
        """Ask the registry, in a thread."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, question, self._registry)

    def close(self) -> None:
        """Ask nothing more."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _resolve(self, league: str, alias: str) -> LoadedVersion:
        """An alias that has no live slot: unknown, too new to have been seen, or not to be loaded."""
        try:
            row = await self.ask(lambda registry: registry.resolve(CheckpointRef(league, alias)))
        except UnknownAlias as error:
            if alias != CHAMPION:
                raise
            raise NotReady(f"league {league} has no champion yet: promote a version first") from error
        try:
            return await self._versions.get(league, row.number)
        except VersionRetired as error:
            raise NotReady(f"{league}@{alias} names a version that was retired: {row.number}") from error
