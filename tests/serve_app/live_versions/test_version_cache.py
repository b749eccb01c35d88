"""Versions in memory: loaded once, not evicted while pinned, and kept if the new version of an alias is invalid."""

import asyncio
import os
import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest

from league.errors import ArtifactCorrupt, Overloaded, StorageError
from league.registry.registry import Registry
from league.registry.storage.manifest import Member, Mixture
from league.registry.storage.rows import VersionState
from serve_app.live_versions.alias_slots import Alias, AliasSlots
from serve_app.live_versions.policies import ActionSelections, LoadedVersion
from serve_app.live_versions.version_cache import MAX_REQUESTED, VersionCache, load
from serve_app.runtime.ray_serve import logger
from tests.support.leagues.served_leagues import publish
from tests.support.policies.graphs import masked_mlp
from tests.support.policies.probes import probes

pytestmark = pytest.mark.anyio


DEADLINE = 30


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
            assert self.gate.wait(DEADLINE)
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
    loaded = await asyncio.gather(*tasks[1:])
    assert {id(version) for version in loaded} == {id(versions.cached("board", 1))}
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


CHAMPION = ("board", "champion")
CANDIDATE = ("board", "candidate")
OTHER = ("vector", "champion")


@pytest.fixture
def versions(registry: Registry) -> VersionCache:
    return VersionCache(partial(load, registry, inline=0.001, selections=ActionSelections()), capacity=1, retry=0)


@pytest.fixture
def slots(versions: VersionCache) -> AliasSlots:
    return AliasSlots(versions)


def number(slots: AliasSlots, alias: str = "champion") -> int | None:
    version = slots.get("board", alias)
    return version and version.number


async def follow(slots: AliasSlots, wanted: dict[Alias, int]) -> None:
    slots.update(wanted)
    await slots.settle(DEADLINE)


def graph(registry: Registry, version: int) -> Path:
    return registry.artifacts.path("board", version) / "shared.onnx"


async def test_slots_follow_their_aliases(slots: AliasSlots, versions: VersionCache) -> None:
    await follow(slots, {CHAMPION: 1, CANDIDATE: 2})
    assert (number(slots), number(slots, "candidate")) == (1, 2)
    await follow(slots, {CHAMPION: 2})
    assert (number(slots), number(slots, "candidate")) == (2, None)
    assert slots.champion("board") is versions.cached("board", 2), "the version is loaded once"
    assert slots.leagues() == ["board"]
    await follow(slots, {})
    assert (number(slots), slots.leagues()) == (None, [])


async def test_a_tampered_version_does_not_go_live(
    slots: AliasSlots, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = Mock()
    monkeypatch.setattr(logger, "error", errors)
    await follow(slots, {CHAMPION: 1})
    content = graph(registry, 2).read_bytes()
    graph(registry, 2).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    for _ in range(3):
        await follow(slots, {CHAMPION: 2})
    assert number(slots) == 1
    assert "shared.onnx was changed" in slots.faults()["board"]
    assert errors.call_count == 1, "logged once"
    graph(registry, 2).write_bytes(content)
    await follow(slots, {CHAMPION: 2})
    assert (number(slots), slots.faults()) == (2, {})


async def test_only_the_files_that_are_served_are_read(slots: AliasSlots, registry: Registry) -> None:
    """The state of training can be as large as a disk is slow."""
    state = registry.artifacts.path("board", 2) / "training" / "state"
    state.unlink()
    os.mkfifo(state)  # reading it would not end
    await follow(slots, {CHAMPION: 2})
    assert (number(slots), slots.faults().get("board")) == (2, None)


@pytest.mark.parametrize(("recorded_of", "answers"), [(3, True), (4, False)], ids=["matching", "other"])
async def test_a_version_goes_live_only_if_its_probes_match(
    slots: AliasSlots, registry: Registry, recorded_of: int, answers: bool
) -> None:
    await follow(slots, {CHAMPION: 1})
    recorded = {"shared": probes(seed=recorded_of)}
    new = publish(registry, "board", {"shared": masked_mlp(seed=3)}, "run/probed", recorded).number
    await follow(slots, {CHAMPION: new})
    assert number(slots) == (new if answers else 1)
    assert (slots.faults().get("board") is None) == answers
    assert answers or "probe observations" in str(slots.faults().get("board"))


@pytest.fixture
def stalled() -> Iterator[Loader]:
    """A loader for which version 2 takes until `gate` opens, as on a disk that does not respond."""
    loader = Loader()
    loader.slow = {2}
    loader.gate.clear()
    yield loader
    loader.gate.set()


async def test_a_later_update_replaces_a_stalled_load(stalled: Loader) -> None:
    slots = AliasSlots(VersionCache(stalled, capacity=2, retry=0))
    await follow(slots, {CHAMPION: 1})
    slots.update({CHAMPION: 2})
    await slots.settle(0.01)
    assert number(slots) == 1
    await follow(slots, {CHAMPION: 3})
    assert number(slots) == 3
    stalled.gate.set()
    await asyncio.to_thread(stalled.gate.wait)
    await slots.settle(DEADLINE)
    assert (number(slots), slots.faults().get("board")) == (3, None), "the version of before does not come back"


async def test_a_load_that_takes_too_long_is_a_fault_until_it_succeeds(stalled: Loader) -> None:
    versions = VersionCache(stalled, capacity=1, retry=0)
    slots = AliasSlots(versions)
    await follow(slots, {CHAMPION: 1})
    versions._timeout = 0.01
    await follow(slots, {CHAMPION: 2})
    assert number(slots) == 1
    assert slots.is_settled
    assert "board@2 was not loaded within 0.01 s" in (slots.faults().get("board") or "")
    await follow(slots, {CHAMPION: 2})
    stalled.gate.set()
    while number(slots) != 2:
        await follow(slots, {CHAMPION: 2})
    assert (slots.faults().get("board"), stalled.calls[2]) == (None, 1), "a stalled thread is not joined"


async def test_any_exception_is_a_fault_of_its_alias(registry: Registry) -> None:
    def exhausted(league: str, number: int) -> LoadedVersion:
        if number == 2:
            raise MemoryError
        return load(registry, league, number, inline=0.001, selections=ActionSelections())

    slots = AliasSlots(VersionCache(exhausted, capacity=1, retry=0))
    await follow(slots, {CHAMPION: 1, OTHER: 1})
    await follow(slots, {CHAMPION: 2, OTHER: 1})
    assert (number(slots), slots.faults()) == (1, {"board": "champion: MemoryError while loading"})
