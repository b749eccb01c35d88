"""A slot changes its version when its alias moves, and keeps it if the new version is invalid."""

import asyncio
import logging
import os
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from league.registry.registry import Registry
from serve_app.live_versions.alias_slots import Alias, AliasSlots
from serve_app.live_versions.version_cache import ActionSelections, LoadedVersion, VersionCache, load
from serve_app.runtime.ray_serve import logger
from tests.support.leagues.served_leagues import publish
from tests.support.policies.graphs import masked_mlp
from tests.support.policies.probes import probes

pytestmark = pytest.mark.anyio
CHAMPION = ("board", "champion")
CANDIDATE = ("board", "candidate")
OTHER = ("vector", "champion")
DEADLINE = 30


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


@pytest.fixture
def log() -> Iterator[list[str]]:
    """The errors that a replica logs, which Serve writes immediately."""
    messages: list[str] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    logger.addHandler(handler)
    yield messages
    logger.removeHandler(handler)


async def test_a_tampered_version_does_not_go_live(slots: AliasSlots, registry: Registry, log: list[str]) -> None:
    await follow(slots, {CHAMPION: 1})
    content = graph(registry, 2).read_bytes()
    graph(registry, 2).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    for _ in range(3):
        await follow(slots, {CHAMPION: 2})
    assert number(slots) == 1
    assert "shared.onnx was changed" in (slots.faults().get("board") or "")
    assert ["version 1 stays" in line for line in log] == [True], "logged once"
    graph(registry, 2).write_bytes(content)
    await follow(slots, {CHAMPION: 2})
    assert (number(slots), slots.faults().get("board")) == (2, None)


@pytest.mark.parametrize("damage", ["truncated", "removed", "empty", "other", "manifest", "extra"])
async def test_a_damaged_version_does_not_go_live(slots: AliasSlots, registry: Registry, damage: str) -> None:
    await follow(slots, {CHAMPION: 1})
    path = graph(registry, 2)
    match damage:
        case "truncated":
            path.write_bytes(path.read_bytes()[:100])
        case "removed":
            path.unlink()
        case "empty":
            path.write_bytes(b"")
        case "other":
            path.write_bytes(graph(registry, 3).read_bytes())
        case "manifest":
            manifest = path.with_name("manifest.json")
            manifest.write_text(manifest.read_text().replace('"steps": 2', '"steps": 3'))
        case "extra":
            path.with_name("extra.bin").write_bytes(b"code")
    await follow(slots, {CHAMPION: 2})
    assert number(slots) == 1
    assert slots.faults().get("board")


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


async def test_going_back_clears_the_fault(slots: AliasSlots, registry: Registry) -> None:
    await follow(slots, {CHAMPION: 1})
    graph(registry, 2).unlink()
    await follow(slots, {CHAMPION: 2})
    assert slots.faults().get("board")
    await follow(slots, {CHAMPION: 1})
    assert (number(slots), slots.faults().get("board")) == (1, None)


async def test_a_fault_in_one_league_does_not_affect_another(slots: AliasSlots, registry: Registry) -> None:
    graph(registry, 1).unlink()
    await follow(slots, {CHAMPION: 1, ("vector", "champion"): 1})
    assert slots.champion("board") is None
    assert slots.champion("vector") is not None
    assert slots.faults().get("vector") is None


async def test_a_live_version_is_not_evicted(slots: AliasSlots, versions: VersionCache) -> None:
    await follow(slots, {CHAMPION: 1})
    for other in (2, 3):
        await versions.get("board", other)
    assert [n for n in (1, 2, 3) if versions.cached("board", n)] == [1, 3]


class Stalled:
    """A loader for which some versions take until `gate` opens, as on a disk that does not respond."""

    def __init__(self, registry: Registry, *numbers: int) -> None:
        self._load = partial(load, registry, inline=0.001, selections=ActionSelections())
        self._numbers = numbers
        self.gate = threading.Event()
        self.calls: list[tuple[str, int]] = []

    def __call__(self, league: str, number: int) -> LoadedVersion:
        self.calls.append((league, number))
        if league == "board" and number in self._numbers:
            assert self.gate.wait(DEADLINE)
        return self._load(league, number)


@pytest.fixture
def stalled(registry: Registry) -> Iterator[Stalled]:
    loader = Stalled(registry, 2)
    yield loader
    loader.gate.set()


async def test_a_stalled_load_delays_no_other_alias(stalled: Stalled) -> None:
    slots = AliasSlots(VersionCache(stalled, capacity=1, retry=0))
    wanted = {CHAMPION: 2, CANDIDATE: 1, OTHER: 1}
    slots.update(wanted)
    while not (slots.is_served(CANDIDATE) and slots.is_served(OTHER)):
        await slots.settle(0.01)
    assert (number(slots), slots.is_settled) == (None, False)
    stalled.gate.set()
    await follow(slots, wanted)
    assert (number(slots), slots.is_settled) == (2, True)


async def test_a_later_update_replaces_a_stalled_load(stalled: Stalled) -> None:
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


async def test_a_load_that_takes_too_long_is_a_fault_until_it_succeeds(stalled: Stalled) -> None:
    slots = AliasSlots(VersionCache(stalled, capacity=1, retry=0, timeout=0.5))
    await follow(slots, {CHAMPION: 1})
    await follow(slots, {CHAMPION: 2})
    assert number(slots) == 1
    assert slots.is_settled
    assert "board@2 was not loaded within 0.5 s" in (slots.faults().get("board") or "")
    await follow(slots, {CHAMPION: 2})
    assert stalled.calls.count(("board", 2)) == 1, "a stalled thread is not joined by another one"
    stalled.gate.set()
    while number(slots) != 2:
        await follow(slots, {CHAMPION: 2})
    assert slots.faults().get("board") is None


async def test_any_exception_is_a_fault_of_its_alias(registry: Registry, log: list[str]) -> None:
    def exhausted(league: str, number: int) -> LoadedVersion:
        if number == 2:
            raise MemoryError
        return load(registry, league, number, inline=0.001, selections=ActionSelections())

    slots = AliasSlots(VersionCache(exhausted, capacity=1, retry=0))
    await follow(slots, {CHAMPION: 1, OTHER: 1})
    await follow(slots, {CHAMPION: 2, OTHER: 1})
    assert (number(slots), slots.faults().get("board"), slots.faults().get("vector")) == (
        1,
        "champion: MemoryError while loading",
        None,
    )
    assert "version 1 stays" in log[0]
