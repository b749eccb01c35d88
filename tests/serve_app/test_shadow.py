"""A shadow sees what the champion has answered, is compared with it, and disturbs nobody."""

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.registry.rows import Portion, Shadowing
from serve_app.app import Server
from serve_app.shadow import MOST_ROWS, Mirrored, Shadow, compare
from tests.league.policies.graphs import masked_mlp
from tests.serve_app.conftest import QUICK
from tests.serve_app.leagues import promote
from tests.serve_app.test_action import BOARD, act, boards
from tests.serve_app.test_alias_watcher import until


@pytest.fixture
def server(registry: Registry) -> Server:
    return Server(Registry.open(registry.storage), QUICK, "replica-1")


@pytest.fixture
def client(server: Server) -> Iterator[TestClient]:
    with TestClient(server.application()) as client:
        yield client


def mirror(registry: Registry, version: int = 2, share: float = 1.0, league: str = "board") -> None:
    setting = registry.set_traffic(league, shadow=Portion(version, share), actor="test", reason="test")
    until(lambda: [one.traffic for one in registry.acknowledgements(league)] == [setting.id])


def seen(registry: Registry, candidate: int = 2, league: str = "board") -> Shadowing | None:
    return next((one for one in registry.shadowings(league) if one.candidate == candidate), None)


def wait_for(registry: Registry, condition: Callable[[Shadowing], bool], **of: Any) -> Shadowing:
    until(lambda: (one := seen(registry, **of)) is not None and condition(one))
    found = seen(registry, **of)
    assert found is not None
    return found


def test_agreement_is_that_of_the_graphs(client: TestClient, registry: Registry) -> None:
    mirror(registry)
    asked = boards(40)
    for board in asked[:20]:
        assert act(client, observation=board)["version"] == 1
    for start in (20, 30):
        act(client, observations=asked[start : start + 8])
    found = wait_for(registry, lambda one: one.requests == 22)
    compared = asked[:28] + asked[30:38]
    batch = {name: np.array([board[name] for board in compared], np.int8) for name in BOARD}
    first, second = (OnnxPolicy(masked_mlp(seed=seed)).act(batch).actions for seed in (0, 1))
    assert (found.candidate, found.champion, found.observations) == (2, 1, 36)
    assert 0 < found.agreed == int((first == second).sum()) < 36
    assert (found.failed, found.dropped, found.skipped) == (0, 0, 0)
    assert 0 < sum(found.latency) <= 22, "those that were computed alone"
    assert found.ns > 0


def test_explored_requests_are_compared_by_their_best_actions(client: TestClient, registry: Registry) -> None:
    promote(registry, "board", 3)
    until(lambda: act(client, observation=BOARD)["version"] == 3)
    mirror(registry, version=1)
    asked = boards(20)
    for board in asked:
        act(client, observation=board, explore=True, seed=1)
    found = wait_for(registry, lambda one: one.observations >= 20, candidate=1)
    batch = {name: np.array([board[name] for board in asked], np.int8) for name in BOARD}
    third, first = (OnnxPolicy(masked_mlp(seed=seed)).act(batch).actions for seed in (2, 0))
    assert (found.observations, found.agreed) == (20, int((third == first).sum()))


def test_what_is_pinned_is_not_mirrored(client: TestClient, registry: Registry) -> None:
    mirror(registry)
    for _ in range(5):
        act(client, version=3, observation=BOARD)
    act(client, observation=BOARD)
    assert wait_for(registry, lambda one: one.requests > 0).requests == 1


def test_state_of_another_network_is_not_mirrored(registry: Registry, client: TestClient) -> None:
    from tests.league.policies.graphs import counting
    from tests.serve_app.leagues import publish

    publish(registry, "memory", {"shared": counting()}, "run/2")
    mirror(registry, league="memory")
    state = act(client, "memory", observation=[1])["state"]
    act(client, "memory", observation=[1], state=state)
    found = wait_for(registry, lambda one: one.requests + one.skipped == 2, league="memory")
    assert (found.requests, found.agreed, found.skipped) == (1, 1, 1)


def test_a_candidate_that_fails_is_counted_and_nobody_else_notices(
    client: TestClient, server: Server, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    mirror(registry)
    candidate = server.versions.held("board", 2)
    assert candidate is not None

    class Broken:
        def act(self, *_: Any, **__: Any) -> None:
            raise MemoryError("no room")

    monkeypatch.setitem(candidate.policies, "shared", type("Policy", (), {"policy": Broken()}))
    for _ in range(10):
        assert act(client, observation=BOARD)["version"] == 1
    found = wait_for(registry, lambda one: one.failed == 10)
    assert (found.requests, found.agreed) == (0, 0)


async def held(registry: Registry) -> tuple[Server, Shadow]:
    server = Server(registry, QUICK.model_copy(update={"shadow_waiting": 4}), "replica-1")
    server.traffic.follow({"board": registry.set_traffic("board", shadow=Portion(2, 1), actor="test", reason="test")})
    await server.live.follow({("board", "champion"): 1, ("board", "2"): 2})
    return server, server.shadow


@pytest.mark.anyio
async def test_what_finds_no_room_is_dropped(registry: Registry) -> None:
    server, shadow = await held(registry)
    champion = server.live.champion("board")
    assert champion is not None
    show = shadow.of("board", champion)
    assert show is not None
    observations = {name: np.array([value], np.int8) for name, value in BOARD.items()}
    for _ in range(10):
        show(observations, None, np.array([0]))
    assert [one.dropped for one in shadow.shadowings()] == [6]
    async with asyncio.timeout(10):
        while shadow.shadowings()[0].requests < 4:
            await asyncio.sleep(0.001)
    show(observations, None, np.array([0]))
    async with asyncio.timeout(10):
        while shadow.shadowings()[0].requests < 5:
            await asyncio.sleep(0.001)
    server.shadow.close()


@pytest.mark.anyio
async def test_half_a_share_mirrors_about_half(registry: Registry) -> None:
    server, shadow = await held(registry)
    half = registry.set_traffic("board", shadow=Portion(2, 0.5), actor="test", reason="test")
    server.traffic.follow({"board": half})
    champion = server.live.champion("board")
    assert champion is not None
    assert 350 < sum(shadow.of("board", champion) is not None for _ in range(1000)) < 650


@pytest.mark.anyio
async def test_no_more_rows_than_fit_are_computed_at_once(registry: Registry, tmp_path: Path) -> None:
    server, _ = await held(registry)
    champion, candidate = server.live.champion("board"), server.live.get("board", "2")
    assert champion is not None
    assert candidate is not None
    random = np.random.default_rng(0)

    def request(rows: int) -> Mirrored:
        batch = {
            "observation": random.integers(0, 2, (rows, 6, 7, 2), dtype=np.int8),
            "action_mask": np.ones((rows, 7), np.int8),
        }
        return Mirrored(candidate, champion, None, batch, champion.policy(None).policy.act(batch).actions)

    requests = [request(rows) for rows in (1, 200, 56, 1, 300, 5)]
    outcomes, seconds = compare(requests)
    assert [outcome.observations for outcome in outcomes] == [1, MOST_ROWS, 1, 300, 5]
    assert [outcome.requests for outcome in outcomes] == [1, 2, 1, 1, 1]
    assert [outcome.ns is not None for outcome in outcomes] == [True, False, False, False, False]
    assert seconds > 0
    alone = [compare([each])[0][0].agreed for each in requests]
    assert sum(alone) == sum(outcome.agreed for outcome in outcomes)
