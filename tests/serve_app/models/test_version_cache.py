"""Versions in memory: concurrent requests load a version once, and pinned versions are not evicted."""

import asyncio
import threading
from collections import Counter
from collections.abc import Awaitable, Callable

import pytest

from league.errors import ArtifactCorrupt, StorageError
from serve_app.models.version_cache import LoadedVersion, VersionCache

pytestmark = pytest.mark.anyio


class Loader:
    """A loader without files that counts its calls; waits for `gate`, and raises `faults`."""

    def __init__(self) -> None:
        self.calls: Counter[int] = Counter()
        self.gate = threading.Event()
        self.gate.set()
        self.faults: dict[int, Exception] = {}

    def __call__(self, league: str, number: int) -> LoadedVersion:
        assert self.gate.wait(10)
        self.calls[number] += 1
        if number in self.faults:
            raise self.faults[number]
        return LoadedVersion(league, number, "0" * 64, {})


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


async def until(attempt: Callable[[], Awaitable[LoadedVersion]]) -> LoadedVersion:
    async with asyncio.timeout(10):
        while True:
            try:
                return await attempt()
            except ArtifactCorrupt:
                await asyncio.sleep(0.01)
