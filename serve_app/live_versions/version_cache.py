"""Loads versions from the artefact store, verifies their probes, and caches them."""

import asyncio
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, replace

import numpy as np

from league.errors import (
    ArtifactCorrupt,
    DeadlineExceeded,
    GraphTimeout,
    InvalidInput,
    NoSearchService,
    Overloaded,
    VersionRetired,
)
from league.policies.onnx import RUN_TIMEOUT, OnnxPolicy
from league.policies.policy import Policy
from league.policies.probes import Probes
from league.registry.registry import Registry
from league.registry.storage.manifest import PolicyManifest
from league.registry.storage.rows import VersionRow, VersionState
from league.spaces.observation_codec import ObservationReader
from serve_app.live_versions.policies import ActionSelections, Graph, LoadedPolicy, LoadedVersion
from serve_app.live_versions.remote_search import RemoteSearch, SearchClient
from serve_app.runtime.background import in_daemon_thread

WARM_BATCH = 64
"""Large enough to measure the time per row, small enough to run in milliseconds."""


def load(
    registry: Registry,
    league: str,
    number: int,
    inline: float,
    selections: ActionSelections,
    timeout: float = RUN_TIMEOUT,
    search: SearchClient | None = None,
    load_timeout: float = RUN_TIMEOUT,
) -> LoadedVersion:
    """Load a version, of a mixture without its members. Blocks.

    inline: time in seconds that inference may take on the event loop. selections: how it selects actions. timeout: time
    in seconds after which a run of a graph, or a search, is ended. search: client of the search service, if there is
    one. load_timeout: time in seconds until it must have loaded a search version.

    Raises UnknownLeague, UnknownVersion, VersionRetired, ArtifactCorrupt or StorageError; what the search service
    raises for a search version, or NoSearchService.
    """
    version = registry.versions.get(league, number)
    if version.retired_at is not None or registry.artifacts.is_purged(league, number):
        raise VersionRetired(
            f"{version.ref} was retired and its files were removed: start a new episode with another version"
        )
    registry.artifacts.verify_names(league, number, version.sha256)
    if version.mixture is not None:
        return LoadedVersion(league, number, version.sha256, {}, version.mixture)
    selections.setdefault(league, registry.leagues.get(league).conditions.actions)
    if version.search is not None:
        if search is None:
            raise NoSearchService("this server has no search service: `search_service` is not set in its deploy.yaml")
        base = registry.versions.get(league, version.search.version)
        return _load_search(version, base, search, selections, timeout, load_timeout)
    graphs: dict[str, tuple[PolicyManifest, Graph, int]] = {}
    for name, manifest in version.manifest.policies.items():
        # Each file is verified as it is read. The others, such as the state of training, can be large.
        content = registry.artifacts.read(version.manifest, manifest.file)
        graph = OnnxPolicy(content, manifest, version.manifest.has_distribution, timeout)
        try:
            if manifest.probes is not None:
                probes = Probes.from_bytes(registry.artifacts.read(version.manifest, manifest.probes), manifest.probes)
                probes.check(graph, manifest.action, f"{version.ref}: {manifest.probes}")
            graphs[name] = manifest, graph, _inline_rows(graph, ObservationReader(manifest.observation), inline)
        except (InvalidInput, GraphTimeout) as error:
            raise ArtifactCorrupt(f"policy {name} of {version.ref} does not run: {error}") from error
    return _loaded(version, graphs, selections)


def _load_search(
    version: VersionRow,
    base: VersionRow,
    search: SearchClient,
    selections: ActionSelections,
    timeout: float,
    load_timeout: float,
) -> LoadedVersion:
    """Let the search service load a version that plays `base`. Its searches never run on the event loop."""
    graphs: dict[str, tuple[PolicyManifest, Graph, int]] = {}
    for name, manifest in base.manifest.policies.items():
        graph = RemoteSearch(search, version, name, manifest.action, timeout)
        graph.load(load_timeout)
        graphs[name] = manifest, graph, 0
    return _loaded(version, graphs, selections)


def _loaded(
    version: VersionRow, graphs: Mapping[str, tuple[PolicyManifest, Graph, int]], selections: ActionSelections
) -> LoadedVersion:
    """graphs: policy → manifest, graph, and the rows that it runs on the event loop."""
    policies = {
        name: LoadedPolicy(
            version.league, version.number, version.sha256, name, len(graphs) == 1, manifest, graph, selections, rows
        )
        for name, (manifest, graph, rows) in graphs.items()
    }
    return LoadedVersion(version.league, version.number, version.sha256, policies)


def _inline_rows(graph: OnnxPolicy, reader: ObservationReader, inline: float) -> int:
    """Run the graph to allocate its memory, and measure how many rows fit into `inline` seconds."""
    one, many = (_measure(graph, reader, rows) for rows in (1, WARM_BATCH))
    per_row = max(many - one, 1e-9) / (WARM_BATCH - 1)
    return 0 if one > inline else 1 + int((inline - one) / per_row)


def _measure(graph: Policy, reader: ObservationReader, rows: int) -> float:
    """Seconds of the fastest of a few runs: slower ones shared the processor."""
    observations = reader.zeros(rows)
    durations = []
    for _ in range(4):
        start = time.perf_counter()
        graph.act(observations)
        durations.append(time.perf_counter() - start)
    return float(np.min(durations))


VersionKey = tuple[str, int]
"""(league, number)"""
REQUESTED_LOADS = 1
"""Versions that are loaded at once because requests name them: they share the processor with everything else."""
MAX_REQUESTED = 64
"""Versions that requests may wait for."""
ALIAS_LOADS = 4
"""Versions that are loaded at once because aliases name them, except those that take longer than FAST_LOAD."""
FAST_LOAD = 1.0
"""Seconds after which a load makes room for the next one."""


@dataclass(slots=True)
class _RequestedLoad:
    """A load for requests that name the version by its number."""

    task: asyncio.Task[LoadedVersion]
    waiting: int = 0
    """Requests that wait for it."""


class VersionCache:
    """Loads versions in threads, each only once at a time, and keeps up to `capacity` versions that are not pinned.

    A load cannot be interrupted: one that does not end, for instance on a stalled mount, keeps its thread. It delays no
    other version that an alias names.

    load: blocks. retry: seconds until a corrupt version is tried again. timeout: seconds that an alias waits for its
    version. All methods run on the event loop.
    """

    def __init__(
        self, load: Callable[[str, int], LoadedVersion], capacity: int, retry: float, timeout: float = 60.0
    ) -> None:
        self._load = load
        self._capacity = capacity
        self._retry = retry
        self._timeout = timeout
        self._loaded: OrderedDict[VersionKey, LoadedVersion] = OrderedDict()
        self._pinned: set[VersionKey] = set()
        self._loading: dict[VersionKey, asyncio.Task[LoadedVersion]] = {}
        self._requested: dict[VersionKey, _RequestedLoad] = {}
        self._of_aliases = asyncio.Semaphore(ALIAS_LOADS)
        self._of_requests = asyncio.Semaphore(REQUESTED_LOADS)
        self._corrupt: dict[VersionKey, tuple[float, ArtifactCorrupt]] = {}
        self._drops = 0
        """Number of calls of `drop_changed`."""

    def pin(self, pinned: set[VersionKey]) -> None:
        """Replace the versions that must stay in memory, whether loaded yet or not."""
        self._pinned = pinned
        self._evict()

    def cached(self, league: str, number: int) -> LoadedVersion | None:
        """A version if it is in memory; marks it as used."""
        if (version := self._loaded.get((league, number))) is not None:
            self._loaded.move_to_end((league, number))
        return version

    def drop_changed(self, states: Mapping[VersionKey, VersionState | None]) -> None:
        """Forget versions that were removed, retired, or replaced by others with the same numbers."""
        for key, state in states.items():
            version = self._loaded.get(key)
            if version is not None and (state is None or state.is_retired or state.sha256 != version.sha256):
                del self._loaded[key]
        mixtures = [(key, version.members) for key, version in self._loaded.items() if version.members]
        for key, members in mixtures:
            if key not in self._pinned and any(
                (member.league, member.number) not in self._loaded for member in members
            ):
                del self._loaded[key]
        self._drops += 1

    def cached_keys(self) -> Set[VersionKey]:
        """The versions in memory, without marking them as used."""
        return self._loaded.keys()

    async def get(self, league: str, number: int) -> LoadedVersion:
        """A version that a request names, loaded if necessary.

        Raises UnknownLeague, UnknownVersion, VersionRetired, ArtifactCorrupt or StorageError; Overloaded if requests
        wait for too many other versions.
        """
        if (version := self.cached(league, number)) is not None:
            return version
        key = (league, number)
        self._refuse_corrupt(key)
        load = self._requested.get(key)
        if load is None:
            if len(self._requested) >= MAX_REQUESTED:
                raise Overloaded(f"requests wait for {MAX_REQUESTED} other versions to be loaded")
            load = self._requested[key] = _RequestedLoad(asyncio.create_task(self._load_in_turn(key)))
            load.task.add_done_callback(lambda _: self._requested.pop(key, None))
        load.waiting += 1
        try:
            return await asyncio.shield(load.task)
        finally:
            load.waiting -= 1
            if not load.waiting:
                load.task.cancel()

    async def get_for_alias(self, league: str, number: int) -> LoadedVersion:
        """A version that an alias names, loaded if necessary, before those that requests name.

        Raises what `get` raises except Overloaded; DeadlineExceeded if it takes longer than the timeout.
        """
        if (version := self.cached(league, number)) is not None:
            return version
        key = (league, number)
        self._refuse_corrupt(key)
        fast = min(FAST_LOAD, self._timeout)
        async with self._of_aliases:
            load = self._start(key)
            await asyncio.wait({load}, timeout=fast)
        done, _ = await asyncio.wait({load}, timeout=self._timeout - fast)
        if not done:
            raise DeadlineExceeded(f"{league}@{number} was not loaded within {self._timeout:g} s")
        return load.result()

    async def _load_in_turn(self, key: VersionKey) -> LoadedVersion:
        await self._of_requests.acquire()
        load = self._start(key)
        load.add_done_callback(lambda _: self._of_requests.release())
        return await asyncio.shield(load)

    def _start(self, key: VersionKey) -> asyncio.Task[LoadedVersion]:
        """The task that loads a version. It is not cancelled: its thread would continue."""
        if (task := self._loading.get(key)) is None:
            task = self._loading[key] = asyncio.create_task(self._fill(key))
            task.add_done_callback(lambda _: self._loading.pop(key, None))
        return task

    async def _fill(self, key: VersionKey) -> LoadedVersion:
        if (version := self.cached(*key)) is not None:
            return version
        try:
            drops = self._drops
            version = await self._with_members(await in_daemon_thread(self._load, *key))
            if drops != self._drops:  # it may have been read before it was removed and published again
                version = await self._with_members(await in_daemon_thread(self._load, *key))
        except ArtifactCorrupt as error:
            self._corrupt[key] = (time.monotonic() + self._retry, error)
            raise
        # Members that were evicted while the others were loaded are pinned from now on if their mixture is.
        self._loaded |= {(member.league, member.number): member for member in version.members}
        self._loaded[key] = version
        self._evict()
        return version

    async def _with_members(self, version: LoadedVersion) -> LoadedVersion:
        """A mixture with its members, which are loaded one after the other to leave time for requests."""
        if version.mixture is None:
            return version
        members = [await self._start((version.league, number)) for number in version.mixture.versions]
        return replace(version, members=tuple(members))

    def _evict(self) -> None:
        pinned = self._pinned | {
            (member.league, member.number)
            for key in self._pinned & self._loaded.keys()
            for member in self._loaded[key].members
        }
        spare = [key for key in self._loaded if key not in pinned]
        for key in spare[: max(0, len(spare) - self._capacity)]:
            del self._loaded[key]

    def _refuse_corrupt(self, key: VersionKey) -> None:
        current_time = time.monotonic()
        self._corrupt = {corrupt_key: fault for corrupt_key, fault in self._corrupt.items() if fault[0] > current_time}
        if key in self._corrupt:
            error = self._corrupt[key][1]
            raise type(error)(*error.args)
