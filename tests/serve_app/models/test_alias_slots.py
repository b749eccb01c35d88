"""A slot changes its version when its alias moves, and keeps it if the new version is invalid."""

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from league.registry.registry import Registry
from serve_app.models.alias_slots import AliasSlots
from serve_app.models.version_cache import VersionCache, load
from serve_app.runtime.ray_serve import logger
from tests.support.leagues.served_leagues import publish
from tests.support.policies.graphs import masked_mlp
from tests.support.policies.probes import probes

pytestmark = pytest.mark.anyio
CHAMPION = ("board", "champion")
CANDIDATE = ("board", "candidate")


@pytest.fixture
def versions(registry: Registry) -> VersionCache:
    return VersionCache(partial(load, registry, inline=0.001), capacity=1, retry=0)


@pytest.fixture
def slots(versions: VersionCache) -> AliasSlots:
    return AliasSlots(versions)


def number(slots: AliasSlots, alias: str = "champion") -> int | None:
    version = slots.get("board", alias)
    return version and version.number


def graph(registry: Registry, version: int) -> Path:
    return registry.artifacts.path("board", version) / "shared.onnx"


async def test_slots_follow_their_aliases(slots: AliasSlots, versions: VersionCache) -> None:
    await slots.update({CHAMPION: 1, CANDIDATE: 2})
    assert (number(slots), number(slots, "candidate")) == (1, 2)
    await slots.update({CHAMPION: 2})
    assert (number(slots), number(slots, "candidate")) == (2, None)
    assert slots.champion("board") is versions.cached("board", 2), "the version is loaded once"
    assert slots.leagues() == ["board"]
    await slots.update({})
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
    await slots.update({CHAMPION: 1})
    content = graph(registry, 2).read_bytes()
    graph(registry, 2).write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    for _ in range(3):
        await slots.update({CHAMPION: 2})
    assert number(slots) == 1
    assert "shared.onnx was changed" in (slots.fault("board") or "")
    assert ["version 1 stays" in line for line in log] == [True], "logged once"
    graph(registry, 2).write_bytes(content)
    await slots.update({CHAMPION: 2})
    assert (number(slots), slots.fault("board")) == (2, None)


@pytest.mark.parametrize("damage", ["truncated", "removed", "empty", "other", "manifest", "training", "extra"])
async def test_a_damaged_version_does_not_go_live(slots: AliasSlots, registry: Registry, damage: str) -> None:
    await slots.update({CHAMPION: 1})
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
        case "training":
            (path.parent / "training" / "state").write_bytes(b"other weights")
        case "extra":
            path.with_name("extra.bin").write_bytes(b"code")
    await slots.update({CHAMPION: 2})
    assert number(slots) == 1
    assert slots.fault("board")


@pytest.mark.parametrize(("recorded_of", "answers"), [(3, True), (4, False)], ids=["matching", "other"])
async def test_a_version_goes_live_only_if_its_probes_match(
    slots: AliasSlots, registry: Registry, recorded_of: int, answers: bool
) -> None:
    await slots.update({CHAMPION: 1})
    recorded = {"shared": probes(seed=recorded_of)}
    new = publish(registry, "board", {"shared": masked_mlp(seed=3)}, "run/probed", recorded).number
    await slots.update({CHAMPION: new})
    assert number(slots) == (new if answers else 1)
    assert (slots.fault("board") is None) == answers
    assert answers or "probe observations" in str(slots.fault("board"))


async def test_going_back_clears_the_fault(slots: AliasSlots, registry: Registry) -> None:
    await slots.update({CHAMPION: 1})
    graph(registry, 2).unlink()
    await slots.update({CHAMPION: 2})
    assert slots.fault("board")
    await slots.update({CHAMPION: 1})
    assert (number(slots), slots.fault("board")) == (1, None)


async def test_a_fault_in_one_league_does_not_affect_another(slots: AliasSlots, registry: Registry) -> None:
    graph(registry, 1).unlink()
    await slots.update({CHAMPION: 1, ("vector", "champion"): 1})
    assert slots.champion("board") is None
    assert slots.champion("vector") is not None
    assert slots.fault("vector") is None


async def test_a_live_version_is_not_evicted(slots: AliasSlots, versions: VersionCache) -> None:
    await slots.update({CHAMPION: 1})
    for other in (2, 3):
        await versions.get("board", other)
    assert [n for n in (1, 2, 3) if versions.cached("board", n)] == [1, 3]
