"""A shadow receives the requests of the champion, is compared with it, and does not affect other requests."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from league.policies import graph_runs
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from serve_app.app import Replica
from serve_app.live_versions.shadow import MAX_ROWS, MirroredRequest, Shadow, compare
from tests.support.clients.actions import BOARD, act, boards
from tests.support.leagues.served_leagues import promote, publish
from tests.support.policies.graphs import endless_mlp, masked_mlp
from tests.support.servers.replicas import QUICK, local_client
from tests.support.servers.shadows import set_shadow, wait_for
from tests.support.waiting import until

FULL = BOARD | {"observation": np.ones((6, 7, 2), int).tolist()}
"""The observation for which `endless_mlp` does not end."""


@pytest.fixture
def server(registry: Registry) -> Replica:
    # Otherwise the shadow pauses for nine times as long as a run that does not end.
    settings = QUICK.model_copy(update={"shadow_load": 0.5})
    return Replica(Registry.open(registry.storage), settings, "replica-1")


@pytest.fixture
def client(server: Replica) -> Iterator[TestClient]:
    with local_client(server) as client:
        yield client


def test_agreement_equals_that_of_the_graphs(client: TestClient, registry: Registry) -> None:
    set_shadow(registry)
    observations = boards(40)
    for board in observations[:20]:
        assert act(client, observation=board)["version"] == 1
    for start in (20, 30):
        act(client, observations=observations[start : start + 8])
    found = wait_for(registry, lambda one: one.requests == 22)
    compared = observations[:28] + observations[30:38]
    batch = {name: np.array([board[name] for board in compared], np.int8) for name in BOARD}
    first, second = (OnnxPolicy(masked_mlp(seed=seed)).act(batch).actions for seed in (0, 1))
    assert (found.candidate, found.champion, found.observations) == (2, 1, 36)
    assert 0 < found.agreed == int((first == second).sum()) < 36
    assert (found.failed, found.dropped, found.skipped) == (0, 0, 0)
    assert 0 < sum(found.latency) <= 22, "only rows computed alone have a latency"
    assert found.ns > 0


def test_explored_requests_are_compared_by_greedy_actions(client: TestClient, registry: Registry) -> None:
    promote(registry, "board", 3)
    until(lambda: act(client, observation=BOARD)["version"] == 3)
    set_shadow(registry, version=1)
    observations = boards(20)
    for board in observations:
        act(client, observation=board, explore=True, seed=1)
    found = wait_for(registry, lambda one: one.observations >= 20, candidate=1)
    batch = {name: np.array([board[name] for board in observations], np.int8) for name in BOARD}
    third, first = (OnnxPolicy(masked_mlp(seed=seed)).act(batch).actions for seed in (2, 0))
    assert (found.observations, found.agreed) == (20, int((third == first).sum()))


def test_pinned_requests_are_not_mirrored(client: TestClient, registry: Registry) -> None:
    set_shadow(registry)
    for _ in range(5):
        act(client, version=3, observation=BOARD)
    act(client, observation=BOARD)
    assert wait_for(registry, lambda one: one.requests > 0).requests == 1


def test_state_of_another_network_is_not_mirrored(registry: Registry, client: TestClient) -> None:
    from tests.support.policies.graphs import counting

    publish(registry, "memory", {"shared": counting()}, "run/2")
    set_shadow(registry, league="memory")
    state = act(client, "memory", observation=[1])["state"]
    act(client, "memory", observation=[1], state=state)
    found = wait_for(registry, lambda one: one.requests + one.skipped == 2, league="memory")
    assert (found.requests, found.agreed, found.skipped) == (1, 1, 1)


def test_a_failing_candidate_is_counted_and_does_not_affect_requests(
    client: TestClient, server: Replica, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_shadow(registry)
    candidate = server.versions.cached("board", 2)
    assert candidate is not None

    class Failing:
        def act(self, *_: Any, **__: Any) -> None:
            raise MemoryError("no room")

    monkeypatch.setitem(
        candidate.policies, "shared", type("Policy", (), {"shadow_policy": Failing(), "samples": False})
    )
    for _ in range(10):
        assert act(client, observation=BOARD)["version"] == 1
    found = wait_for(registry, lambda one: one.failed == 10)
    assert (found.requests, found.agreed) == (0, 0)


def shadow_policy(server: Replica, version: int) -> OnnxPolicy:
    """The policy of a version of `board` with which a shadow runs."""
    candidate = server.versions.cached("board", version)
    assert candidate is not None
    policy = candidate.policies["shared"].shadow_policy
    assert isinstance(policy, OnnxPolicy)
    return policy


def test_a_run_that_does_not_end_is_counted(
    client: TestClient, server: Replica, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that wait for the same version are counted without being run."""
    monkeypatch.setattr("serve_app.live_versions.version_cache.SHADOW_TIMEOUT", 0.1)
    endless = publish(registry, "board", {"shared": endless_mlp()}, "run/endless").number
    set_shadow(registry, version=endless)
    for _ in range(20):
        assert act(client, observation=FULL)["version"] == 1
    found = wait_for(registry, lambda one: one.failed == 20, candidate=endless)
    assert found.requests == 0
    monkeypatch.setattr(shadow_policy(server, endless), "_timeout", 60.0)  # a busy machine may need more than 0.1 s
    act(client, observation=BOARD)
    wait_for(registry, lambda one: one.requests == 1, candidate=endless)


def test_runs_end_when_the_shadow_is_switched_off(
    client: TestClient, server: Replica, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("serve_app.live_versions.version_cache.SHADOW_TIMEOUT", 600.0)
    endless = publish(registry, "board", {"shared": endless_mlp()}, "run/endless").number
    set_shadow(registry, version=endless)
    owner = shadow_policy(server, endless)._owner
    assert owner is not None

    def runs() -> int:
        return sum(run.owner is owner for run in tuple(graph_runs._runs))

    act(client, observation=FULL)
    until(lambda: runs() == 1)
    registry.traffic.set("board", shadow=None, actor="test", reason="test")
    until(lambda: runs() == 0)
    wait_for(registry, lambda one: one.failed == 1, candidate=endless)


async def replica_with_shadow(registry: Registry) -> tuple[Replica, Shadow]:
    server = Replica(registry, QUICK.model_copy(update={"shadow_waiting": 4}), "replica-1")
    server.traffic.update({"board": registry.traffic.set("board", shadow=Portion(2, 1), actor="test", reason="test")})
    server.alias_slots.update({("board", "champion"): 1, ("board", "2"): 2})
    await server.alias_slots.settle(30)
    return server, server.shadow


async def wait_for_requests(shadow: Shadow, number: int) -> None:
    async with asyncio.timeout(60):
        while shadow.shadowings()[0].requests < number:
            await asyncio.sleep(0.001)


@pytest.mark.anyio
async def test_requests_beyond_the_queue_limit_are_dropped(registry: Registry) -> None:
    server, shadow = await replica_with_shadow(registry)
    champion = server.alias_slots.champion("board")
    assert champion is not None
    mirror = shadow.mirror_for("board", champion)
    assert mirror is not None
    observations = {name: np.array([value], np.int8) for name, value in BOARD.items()}
    for _ in range(10):
        mirror(observations, None, np.array([0]))
    assert [one.dropped for one in shadow.shadowings()] == [6]
    await wait_for_requests(shadow, 4)
    mirror(observations, None, np.array([0]))
    await wait_for_requests(shadow, 5)
    server.shadow.close()


@pytest.mark.anyio
async def test_observations_beyond_the_size_limit_of_the_queue_are_dropped(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, shadow = await replica_with_shadow(registry)
    champion = server.alias_slots.champion("board")
    assert champion is not None
    mirror = shadow.mirror_for("board", champion)
    assert mirror is not None
    observations = {name: np.array([value], np.int8) for name, value in BOARD.items()}
    size = sum(array.nbytes for array in observations.values())
    monkeypatch.setattr("serve_app.live_versions.shadow.MAX_WAITING_BYTES", 2 * size)
    for _ in range(3):
        mirror(observations, None, np.array([0]))
    assert [one.dropped for one in shadow.shadowings()] == [1]
    server.shadow.close()


@pytest.mark.anyio
async def test_a_share_of_one_half_mirrors_about_half(registry: Registry) -> None:
    server, shadow = await replica_with_shadow(registry)
    half = registry.traffic.set("board", shadow=Portion(2, 0.5), actor="test", reason="test")
    server.traffic.update({"board": half})
    champion = server.alias_slots.champion("board")
    assert champion is not None
    assert 350 < sum(shadow.mirror_for("board", champion) is not None for _ in range(1000)) < 650


@pytest.mark.anyio
async def test_the_number_of_rows_computed_at_once_is_limited(registry: Registry, tmp_path: Path) -> None:
    server, _ = await replica_with_shadow(registry)
    champion, candidate = server.alias_slots.champion("board"), server.alias_slots.get("board", "2")
    assert champion is not None
    assert candidate is not None
    random = np.random.default_rng(0)

    def request(rows: int) -> MirroredRequest:
        batch = {
            "observation": random.integers(0, 2, (rows, 6, 7, 2), dtype=np.int8),
            "action_mask": np.ones((rows, 7), np.int8),
        }
        return MirroredRequest(candidate, champion, None, batch, champion.policy(None).policy.act(batch).actions)

    requests = [request(rows) for rows in (1, 200, 56, 1, 300, 5)]
    outcomes, seconds = compare(requests)
    assert [outcome.observations for outcome in outcomes] == [1, MAX_ROWS, 1, 300, 5]
    assert [outcome.requests for outcome in outcomes] == [1, 2, 1, 1, 1]
    assert [outcome.ns is not None for outcome in outcomes] == [True, False, False, False, False]
    assert seconds > 0
    alone = [compare([each])[0][0].agreed for each in requests]
    assert sum(alone) == sum(outcome.agreed for outcome in outcomes)
