"""A slot swaps when its alias moves, and keeps what it has when the successor is no good."""

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from league.registry.registry import Registry
from serve_app.live import Live, logger
from serve_app.loading import load
from serve_app.versions import Versions
from tests.league.policies.graphs import masked_mlp
from tests.league.policies.test_probes import probes
from tests.serve_app.leagues import publish

pytestmark = pytest.mark.anyio
CHAMPION = ("board", "champion")
CANDIDATE = ("board", "candidate")


@pytest.fixture
def versions(registry: Registry) -> Versions:
    return Versions(partial(load, registry, inline=0.001), capacity=1, retry=0)


@pytest.fixture
def live(versions: Versions) -> Live:
    return Live(versions)


def number(live: Live, alias: str = "champion") -> int | None:
    version = live.get("board", alias)
    return version and version.number


def graph(registry: Registry, version: int) -> Path:
    return registry.artifacts.path("board", version) / "shared.onnx"


async def test_slots_follow_their_aliases(live: Live, versions: Versions) -> None:
    await live.follow({CHAMPION: 1, CANDIDATE: 2})
    assert (number(live), number(live, "candidate")) == (1, 2)
    await live.follow({CHAMPION: 2})
    assert (number(live), number(live, "candidate")) == (2, None)
    assert live.champion("board") is versions.held("board", 2), "loaded once for both aliases"
    assert live.leagues() == ["board"]
    await live.follow({})
    assert (number(live), live.leagues()) == (None, [])


@pytest.fixture
def log() -> Iterator[list[str]]:
    """What a replica logs as errors, which Serve writes at once."""
    told: list[str] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: told.append(record.getMessage())  # type: ignore[method-assign]
    logger.addHandler(handler)
    yield told
    logger.removeHandler(handler)


async def test_a_tampered_version_does_not_go_live(live: Live, registry: Registry, log: list[str]) -> None:
    await live.follow({CHAMPION: 1})
    whole = graph(registry, 2).read_bytes()
    graph(registry, 2).write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    for _ in range(3):
        await live.follow({CHAMPION: 2})
    assert number(live) == 1
    assert "shared.onnx was changed" in (live.fault("board") or "")
    assert ["version 1 stays" in line for line in log] == [True], "once, not at every look"
    graph(registry, 2).write_bytes(whole)
    await live.follow({CHAMPION: 2})
    assert (number(live), live.fault("board")) == (2, None)


@pytest.mark.parametrize("damage", ["cut", "removed", "emptied", "another's", "manifest", "training", "stranger"])
async def test_no_damage_goes_live(live: Live, registry: Registry, damage: str) -> None:
    await live.follow({CHAMPION: 1})
    path = graph(registry, 2)
    match damage:
        case "cut":
            path.write_bytes(path.read_bytes()[:100])
        case "removed":
            path.unlink()
        case "emptied":
            path.write_bytes(b"")
        case "another's":
            path.write_bytes(graph(registry, 3).read_bytes())
        case "manifest":
            manifest = path.with_name("manifest.json")
            manifest.write_text(manifest.read_text().replace('"steps": 2', '"steps": 3'))
        case "training":
            (path.parent / "training" / "state").write_bytes(b"other weights")
        case "stranger":
            path.with_name("extra.bin").write_bytes(b"code")
    await live.follow({CHAMPION: 2})
    assert number(live) == 1
    assert live.fault("board")


@pytest.mark.parametrize(("recorded_of", "answers"), [(3, True), (4, False)], ids=["its own", "another's"])
async def test_a_version_answers_its_probes_before_it_goes_live(
    live: Live, registry: Registry, recorded_of: int, answers: bool
) -> None:
    await live.follow({CHAMPION: 1})
    recorded = {"shared": probes(seed=recorded_of)}
    new = publish(registry, "board", {"shared": masked_mlp(seed=3)}, "run/probed", recorded).number
    await live.follow({CHAMPION: new})
    assert number(live) == (new if answers else 1)
    assert (live.fault("board") is None) == answers
    assert answers or "probe observations" in str(live.fault("board"))


async def test_going_back_clears_the_fault(live: Live, registry: Registry) -> None:
    await live.follow({CHAMPION: 1})
    graph(registry, 2).unlink()
    await live.follow({CHAMPION: 2})
    assert live.fault("board")
    await live.follow({CHAMPION: 1})
    assert (number(live), live.fault("board")) == (1, None)


async def test_one_league_s_fault_does_not_hold_up_another(live: Live, registry: Registry) -> None:
    graph(registry, 1).unlink()
    await live.follow({CHAMPION: 1, ("vector", "champion"): 1})
    assert live.champion("board") is None
    assert live.champion("vector") is not None
    assert live.fault("vector") is None


async def test_a_live_version_is_not_evicted(live: Live, versions: Versions) -> None:
    await live.follow({CHAMPION: 1})
    for other in (2, 3):
        await versions.get("board", other)
    assert [n for n in (1, 2, 3) if versions.held("board", n)] == [1, 3]
