"""Versions in memory: loaded once at a time, and never forgotten while they are live."""

import asyncio
import threading
from collections import Counter
from collections.abc import Awaitable, Callable

import pytest

from league.errors import ArtifactCorrupt, StorageError
from serve_app.loading import LoadedVersion
from serve_app.versions import Versions

pytestmark = pytest.mark.anyio


class Loader:
    """Loads versions out of nothing and counts; waits for `gate`, and raises `faults`."""

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


def held(versions: Versions, numbers: range) -> list[int]:
    return [number for number in numbers if versions.held("board", number)]


async def test_many_who_ask_at_once_cause_one_load() -> None:
    loader = Loader()
    loader.gate.clear()
    versions = Versions(loader, capacity=2, retry=1)
    asking = [asyncio.create_task(versions.get("board", 1)) for _ in range(10)]
    await asyncio.sleep(0)
    asking[0].cancel()
    loader.gate.set()
    found = await asyncio.gather(*asking[1:])
    assert {id(version) for version in found} == {id(versions.held("board", 1))}
    assert loader.calls == {1: 1}


async def test_the_ones_longest_unused_go() -> None:
    versions = Versions(Loader(), capacity=2, retry=1)
    for number in (1, 2, 1, 3):
        await versions.get("board", number)
    assert held(versions, range(1, 4)) == [1, 3]


async def test_live_ones_stay() -> None:
    versions = Versions(Loader(), capacity=1, retry=1)
    versions.keep({("board", 1), ("board", 2)})
    for number in range(1, 6):
        await versions.get("board", number)
    assert held(versions, range(1, 6)) == [1, 2, 5]
    versions.keep({("board", 2)})
    assert held(versions, range(1, 6)) == [2, 5]


async def test_a_corrupt_version_is_tried_again_after_a_while() -> None:
    loader = Loader()
    loader.faults[1] = ArtifactCorrupt("shared.onnx was changed")
    versions = Versions(loader, capacity=1, retry=0.05)
    for _ in range(5):
        with pytest.raises(ArtifactCorrupt, match="changed"):
            await versions.get("board", 1)
    assert loader.calls == {1: 1}
    loader.faults.clear()
    assert (await until(lambda: versions.get("board", 1))).number == 1


async def test_a_fault_of_the_storage_is_not_remembered() -> None:
    loader = Loader()
    loader.faults[1] = StorageError("the disk is gone")
    versions = Versions(loader, capacity=1, retry=60)
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
