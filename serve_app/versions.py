"""The versions that a replica holds in memory: those that are live, and the last few that were asked for by number."""

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Set
from concurrent.futures import ThreadPoolExecutor

from league.errors import ArtifactCorrupt
from serve_app.loading import LoadedVersion

Key = tuple[str, int]
"""(league, number)"""


class Versions:
    """Loads versions in threads, each once at a time, and keeps `capacity` of those that are not live.

    load: blocks; raises LeagueError.
    retry: seconds for which a corrupt version is not tried again.
    Everything but `load` runs on the event loop.
    """

    def __init__(self, load: Callable[[str, int], LoadedVersion], capacity: int, retry: float) -> None:
        self._load = load
        self._capacity = capacity
        self._retry = retry
        self._threads = ThreadPoolExecutor(max_workers=2, thread_name_prefix="load")
        self._loaded: OrderedDict[Key, LoadedVersion] = OrderedDict()
        self._live: set[Key] = set()
        self._loading: dict[Key, asyncio.Task[LoadedVersion]] = {}
        self._corrupt: dict[Key, tuple[float, ArtifactCorrupt]] = {}

    def keep(self, live: set[Key]) -> None:
        """Name the versions that must stay, whether they are loaded yet or not; the others grow old."""
        self._live = live
        self._evict()

    def held(self, league: str, number: int) -> LoadedVersion | None:
        """A version, if it is in memory; it counts as used."""
        if (version := self._loaded.get((league, number))) is not None:
            self._loaded.move_to_end((league, number))
        return version

    def loaded(self) -> Set[Key]:
        """The versions in memory. None of them counts as used."""
        return self._loaded.keys()

    async def get(self, league: str, number: int) -> LoadedVersion:
        """A version, loaded if need be. Raises UnknownLeague, UnknownVersion, ArtifactCorrupt or StorageError."""
        if (version := self.held(league, number)) is not None:
            return version
        key = (league, number)
        self._refuse_corrupt(key)
        task = self._loading.get(key)
        if task is None:
            task = self._loading[key] = asyncio.create_task(self._fill(key))
            task.add_done_callback(lambda _: self._loading.pop(key, None))
        # Others may wait for the same version when one of them gives up.
        return await asyncio.shield(task)

    def close(self) -> None:
        """Stop loading."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _fill(self, key: Key) -> LoadedVersion:
        try:
            version = await asyncio.get_running_loop().run_in_executor(self._threads, self._load, *key)
        except ArtifactCorrupt as error:
            self._corrupt[key] = (time.monotonic() + self._retry, error)
            raise
        self._loaded[key] = version
        self._evict()
        return version

    def _evict(self) -> None:
        spare = [key for key in self._loaded if key not in self._live]
        for key in spare[: max(0, len(spare) - self._capacity)]:
            del self._loaded[key]

    def _refuse_corrupt(self, key: Key) -> None:
        now = time.monotonic()
        self._corrupt = {known: fault for known, fault in self._corrupt.items() if fault[0] > now}
        if key in self._corrupt:
            error = self._corrupt[key][1]
            raise type(error)(*error.args)
