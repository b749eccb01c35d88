"""Versions in memory: concurrent requests load a version once, and pinned versions are not evicted."""

import asyncio
import threading
from collections import Counter
from collections.abc import Awaitable, Callable

import pytest

from league.errors import ArtifactCorrupt, Overloaded, StorageError
from league.registry.storage.manifest import Member, Mixture
from league.registry.storage.rows import VersionState
from serve_app.live_versions.version_cache import MAX_REQUESTED, LoadedVersion, VersionCache

pytestmark = pytest.mark.anyio


class Loader:
    """A loader without files that counts its calls; raises `faults`, and waits for `gate` if a version is in `slow`."""

    def __init__(self) -> None:
        self.calls: Counter[int] = Counter()
        self.gate = threading.Event()
        self.gate.set()
        self.faults: dict[int, Exception] = {}
        self.slow: set[int] | None = None
        self.sha256 = "0" * 64

    def __call__(self, league: str, number: int) -> LoadedVersion:
        if self.slow is None or number in self.slow:
            assert self.gate.wait(10)
        self.calls[number] += 1
        if number in self.faults:
            raise self.faults[number]
        return LoadedVersion(league, number, self.sha256, {})


def cached(versions: VersionCache, numbers: range) -> list[int]:
    return [number for number in numbers if versions.cached("board", number)]


async def test_concurrent_requests_cause_one_load() -> None:
    loader = Loader()
    loader.gate.clear()
    versions = VersionCache(loader, capacity=2, retry=1)
    tasks = [asyncio.create_task(versions.get("board", 1)) for _ in range(10)]
    await asyncio.sleep(0)
    tasks[0].cancel()
    loader.gate.set()
    found = await asyncio.gather(*tasks[1:])
    assert {id(version) for version in found} == {id(versions.cached("board", 1))}
    assert loader.calls == {1: 1}


async def test_the_least_recently_used_versions_are_evicted() -> None:
    versions = VersionCache(Loader(), capacity=2, retry=1)
    for number in (1, 2, 1, 3):
        await versions.get("board", number)
    assert cached(versions, range(1, 4)) == [1, 3]


async def test_pinned_versions_are_not_evicted() -> None:
    versions = VersionCache(Loader(), capacity=1, retry=1)
    versions.pin({("board", 1), ("board", 2)})
    for number in range(1, 6):
        await versions.get("board", number)
    assert cached(versions, range(1, 6)) == [1, 2, 5]
    versions.pin({("board", 2)})
    assert cached(versions, range(1, 6)) == [2, 5]


async def test_changed_versions_are_dropped() -> None:
    loader = Loader()
    versions = VersionCache(loader, capacity=5, retry=1)
    for number in range(1, 5):
        await versions.get("board", number)
    same, other = VersionState(loader.sha256, is_retired=False), VersionState("1" * 64, is_retired=False)
    retired = VersionState(loader.sha256, is_retired=True)
    versions.drop_changed({("board", 1): same, ("board", 2): other, ("board", 3): retired, ("board", 4): None})
    assert cached(versions, range(1, 5)) == [1]


async def test_a_version_that_is_replaced_while_it_is_loaded_is_loaded_again() -> None:
    started, gate = threading.Event(), threading.Event()
    digests = iter(["0" * 64, "1" * 64])

    def load(league: str, number: int) -> LoadedVersion:
        version = LoadedVersion(league, number, next(digests), {})
        started.set()
        assert gate.wait(60)
        return version

    versions = VersionCache(load, capacity=1, retry=1)
    loading = asyncio.create_task(versions.get("board", 1))
    await asyncio.to_thread(started.wait)
    versions.drop_changed({})
    gate.set()
    assert (await loading).sha256 == "1" * 64


async def test_a_mixture_is_dropped_with_its_members() -> None:
    members = tuple(Member(version=number, probability=0.5, sha256="0" * 64) for number in (1, 2))

    def load(league: str, number: int) -> LoadedVersion:
        mixture = Mixture(members=members) if number == 3 else None
        return LoadedVersion(league, number, "0" * 64, {}, mixture)

    versions = VersionCache(load, capacity=5, retry=1)
    assert [member.number for member in (await versions.get("board", 3)).members] == [1, 2]
    versions.drop_changed({("board", 2): VersionState("0" * 64, is_retired=True)})
    assert cached(versions, range(1, 4)) == [1]


async def test_a_corrupt_version_is_retried_after_an_interval() -> None:
    loader = Loader()
    loader.faults[1] = ArtifactCorrupt("shared.onnx was changed")
    versions = VersionCache(loader, capacity=1, retry=0.05)
    for _ in range(5):
        with pytest.raises(ArtifactCorrupt, match="changed"):
            await versions.get("board", 1)
    assert loader.calls == {1: 1}
    loader.faults.clear()
    assert (await until(lambda: versions.get("board", 1))).number == 1


async def test_a_storage_error_is_not_cached() -> None:
    loader = Loader()
    loader.faults[1] = StorageError("the disk is gone")
    versions = VersionCache(loader, capacity=1, retry=60)
    with pytest.raises(StorageError):
        await versions.get("board", 1)
    loader.faults.clear()
    assert (await versions.get("board", 1)).number == 1


async def test_requests_wait_in_turn_and_leave_the_queue_when_they_end() -> None:
    loader = Loader()
    loader.gate.clear()
    versions = VersionCache(loader, capacity=8, retry=1)
    tasks = {number: asyncio.create_task(versions.get("board", number)) for number in range(1, 6)}
    await asyncio.sleep(0)
    for number in (2, 3, 4):
        tasks[number].cancel()
    await asyncio.wait([tasks[number] for number in (2, 3, 4)])
    loader.gate.set()
    await asyncio.gather(tasks[1], tasks[5])
    assert loader.calls == {1: 1, 5: 1}, "nobody waits for the others any more"


async def test_requests_wait_for_a_limited_number_of_versions() -> None:
    loader = Loader()
    loader.gate.clear()
    versions = VersionCache(loader, capacity=1, retry=1)
    tasks = [asyncio.create_task(versions.get("board", number)) for number in range(MAX_REQUESTED)]
    await asyncio.sleep(0)
    with pytest.raises(Overloaded, match="wait for 64 other versions"):
        await versions.get("board", MAX_REQUESTED)
    again = asyncio.create_task(versions.get("board", 0))
    loader.gate.set()
    await asyncio.gather(*tasks, again)
    assert (await versions.get("board", MAX_REQUESTED)).number == MAX_REQUESTED


async def test_aliases_do_not_wait_for_requests() -> None:
    loader = Loader()
    loader.slow = {1}
    loader.gate.clear()
    versions = VersionCache(loader, capacity=8, retry=1)
    requests = [asyncio.create_task(versions.get("board", number)) for number in (1, 2, 3)]
    await asyncio.sleep(0)
    assert (await versions.get_for_alias("board", 4)).number == 4
    assert (await versions.get_for_alias("board", 3)).number == 3, "also if a request waits for the same version"
    assert loader.calls == {4: 1, 3: 1}
    loader.gate.set()
    assert [version.number for version in await asyncio.gather(*requests)] == [1, 2, 3]
    assert loader.calls[3] == 1


async def until(attempt: Callable[[], Awaitable[LoadedVersion]]) -> LoadedVersion:
    async with asyncio.timeout(10):
        while True:
            try:
                return await attempt()
            except ArtifactCorrupt:
                await asyncio.sleep(0.01)
