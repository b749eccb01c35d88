"""Many replicas in one process that follow a registry and serve nothing.

`python -m benchmarks.registry.watchers NUMBER HOME DATABASE_URL` prints a line as soon as all follow. Each has the
watcher and the connection of a replica; versions are loaded at once, from nothing.
"""

import asyncio
import sys
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.access.api_keys import ApiKeyCache
from serve_app.live_versions.alias_slots import AliasSlots
from serve_app.live_versions.policies import ActionSelections, LoadedVersion
from serve_app.live_versions.registry_connection import RegistryConnection
from serve_app.live_versions.registry_watcher import RegistryWatcher, WatchedState
from serve_app.live_versions.traffic_split import TrafficSplit
from serve_app.live_versions.version_cache import VersionCache
from serve_app.runtime.replica_process import this_process
from serve_app.settings import ServeSettings


def watcher(storage: Storage, name: str) -> tuple[RegistryWatcher, RegistryConnection]:
    """A replica's watcher and its connection."""
    settings = ServeSettings()
    load = partial(LoadedVersion, sha256="0" * 64, policies={})
    slots = AliasSlots(VersionCache(load, settings.cached_versions, settings.retry, settings.load_timeout))
    connection = RegistryConnection(Registry.open(storage, create=False, listens=True))
    return (
        RegistryWatcher(
            connection,
            WatchedState(slots, TrafficSplit(slots), ActionSelections(), ApiKeyCache().update),
            name,
            this_process(),
            settings,
        ),
        connection,
    )


async def _follow(number: int, storage: Storage) -> None:
    async with AsyncExitStack() as stack:
        for i in range(number):
            follower, connection = watcher(storage, f"replica-{i:04}")
            stack.callback(connection.close)
            await stack.enter_async_context(follower.watching())
        print("follow", flush=True)
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    home = Path(sys.argv[2])
    asyncio.run(_follow(int(sys.argv[1]), Storage(home, sys.argv[3], home / "artifacts")))
