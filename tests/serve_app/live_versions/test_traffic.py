"""Which version answers which key: canaries and mixtures, and shadows, which are compared with the champion."""

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator
from threading import Event
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient, WebSocketDenialResponse

from league.errors import InvalidInput
from league.policies.loading import load
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import Mixture
from league.registry.storage.rows import Portion
from league.settings import Storage
from policy_league_client.endpoint import Endpoint
from policy_league_client.requests import ActionRequest
from policy_league_client.responses import parse_model
from policy_league_client.stream_protocol import StreamProtocol
from serve_app.app import Replica
from serve_app.live_versions.policies import LoadedPolicy
from serve_app.live_versions.shadow import Shadow
from tests.support.clients.actions import (
    BOARD,
    act,
    board_arrays,
    boards,
    change,
    inference,
    key_position,
    rejected,
    version_for,
)
from tests.support.clients.streams import answer_to, open_stream
from tests.support.leagues.registries import traffic_history
from tests.support.leagues.served_leagues import everything, promote, publish
from tests.support.policies.graphs import counting, endless_mlp, masked_mlp, memoryless
from tests.support.servers.exposition import value
from tests.support.servers.replicas import QUICK, READ_ONLY, local_client, replica
from tests.support.servers.shadows import set_shadow, wait_for
from tests.support.waiting import until

TRAFFIC = "/v1/leagues/board/traffic"
KEYS = [f"player-{number}" for number in range(200)]
EPISODES = [f"episode-{number}" for number in range(24)]


@given(st.binary(), st.floats(0, 1), st.floats(0, 1))
def test_a_larger_share_only_adds_keys(key: bytes, share: float, other: float) -> None:
    assert 0 <= (at := key_position("board", key)) < 1
    smaller, larger = sorted((share, other))
    assert not (at < smaller and at >= larger)


def test_keys_are_spread_evenly_and_differently_in_each_league() -> None:
    positions = [key_position("board", key.encode()) for key in KEYS]
    assert 60 < sum(at < 0.5 for at in positions) < 140
    assert positions != [key_position("duo", key.encode()) for key in KEYS]
    assert key_position("board", b"player-0") == 0.47714954489280714, "stable across replicas and releases"


def versions_by_key(client: TestClient) -> dict[str, int]:
    return {key: version_for(client, key) for key in EPISODES}


def set_traffic(registry: Registry, **portions: Any) -> Callable[[], bool]:
    """Set traffic; returns a function that tells whether the replica follows it."""
    setting = registry.traffic.set("board", **portions, actor="test", reason="test")
    return lambda: [one.traffic for one in registry.replicas.acknowledgements("board")] == [setting.id]


def test_a_canary_answers_its_share_of_keys(client: TestClient, registry: Registry) -> None:
    for share in (0.25, 0.5):
        until(set_traffic(registry, canary=Portion(2, share)))
        expected = {key: 1 + (key_position("board", key.encode()) < share) for key in EPISODES}
        assert versions_by_key(client) == versions_by_key(client) == expected
    promote(registry, "board", 2)
    until(lambda: version_for(client) == 2)
    assert set(versions_by_key(client).values()) == {2}
    until(set_traffic(registry, canary=None))
    promote(registry, "board", 1)
    until(lambda: version_for(client) == 1)
    assert set(versions_by_key(client).values()) == {1}


def test_without_a_key_or_with_a_version_there_is_no_canary(client: TestClient, registry: Registry) -> None:
    until(set_traffic(registry, canary=Portion(2, 1.0)))
    assert version_for(client, "anybody") == 2
    assert version_for(client) == 1
    assert version_for(client, "anybody", version="champion") == 2
    assert version_for(client, "anybody", version="1") == 1


def test_a_canary_by_alias_moves_with_it(client: TestClient, registry: Registry) -> None:
    registry.aliases.set("board", "candidate", 2, expected=ANY, actor="test", reason="test")
    until(set_traffic(registry, canary=Portion("candidate", 1.0)))
    assert version_for(client, "anybody") == 2
    registry.aliases.set("board", "candidate", 3, expected=ANY, actor="test", reason="test")
    until(lambda: version_for(client, "anybody") == 3)


def test_a_canary_that_cannot_be_loaded_is_not_used(client: TestClient, registry: Registry) -> None:
    (registry.artifacts.path("board", 2) / "shared.onnx").write_bytes(b"tampered")
    follows = set_traffic(registry, canary=Portion(2, 1.0))
    until(lambda: any(row.fault for row in registry.replicas.acknowledgements("board")))
    assert version_for(client, "anybody") == 1
    assert not follows()
    assert "2: " in str(registry.replicas.acknowledgements("board")[0].fault)


def test_inference_has_the_same_canary(client: TestClient, registry: Registry) -> None:
    until(set_traffic(registry, canary=Portion(2, 0.5)))
    body = inference(board_arrays([BOARD]))
    for key in KEYS[:20]:
        reply = client.post("/v2/models/board/infer", json=body, headers={"x-league-key": key})
        assert int(reply.json()["model_version"]) == version_for(client, key)


def test_traffic_is_set_over_http(promoter: TestClient, registry: Registry) -> None:
    body = {"canary": {"version": 2, "share": 0.05}, "reason": "try it"}
    response = change(promoter, TRAFFIC, "a", body)
    assert (response["canary"], response["shadow"]) == ({"version": 2, "share": 0.05}, None)
    assert (response["actor"], response["reason"]) == ("release-bot", "try it")
    assert change(promoter, TRAFFIC, "a", body) == response, "a repeated call has the same response"
    shadow = {"shadow": {"version": "3", "share": 1}}
    assert change(promoter, TRAFFIC, "b", shadow)["canary"] == response["canary"], "the canary remains"
    both = change(promoter, TRAFFIC, "c", {"canary": None, "shadow": None})
    assert (both["canary"], both["shadow"]) == (None, None)
    assert [one.canary and one.canary.share for one in traffic_history(registry, "board")] == [None, 0.05, 0.05]
    until(lambda: promoter.get(TRAFFIC).json()["replicas"][0]["follows"])


def test_invalid_traffic_is_rejected(promoter: TestClient, registry: Registry, subtests: pytest.Subtests) -> None:
    for body, status, code in (
        ({"canary": {"version": 9, "share": 0.1}}, 404, "unknown_version"),
        ({"canary": {"version": "nobody", "share": 0.1}}, 404, "unknown_alias"),
        ({"canary": {"version": "champion", "share": 0.1}}, 400, "invalid_input"),
        ({"canary": {"version": 2, "share": 1.1}}, 400, "invalid_input"),
        ({"canary": {"version": 2}}, 400, "invalid_input"),
        ({"canary": {"version": 0, "share": 0.1}}, 400, "invalid_input"),
        ({"canary": {"version": True, "share": 0.1}}, 400, "invalid_input"),
        ({"canarie": None}, 400, "invalid_input"),
    ):
        with subtests.test(body=body):
            assert change(promoter, TRAFFIC, "a", body, status)["code"] == code
    assert registry.traffic.current("board").id is None


MEMBERS = {1: OnnxPolicy(masked_mlp(seed=0)), 3: OnnxPolicy(masked_mlp(seed=2))}


def mix(registry: Registry, shares: dict[int, float], league: str = "board") -> Mixture:
    """Make a mixture the champion, and wait until the replicas serve it."""
    row = registry.publisher.publish_mixture(league, shares)
    promote(registry, league, row.number)
    registry.changes.wait_for_alias(registry.aliases.history(league)[0], 30)
    assert row.mixture is not None
    return row.mixture


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[TestClient, Mixture]]:
    """A replica whose champion of `board` is a mixture."""
    registry = everything(Storage.at(tmp_path_factory.mktemp("mixed")))
    with replica(registry.storage, READ_ONLY) as client:
        yield client, mix(registry, {1: 0.5, 3: 0.5})
    registry.close()


def test_a_key_selects_its_member(mixed: tuple[TestClient, Mixture]) -> None:
    client, mixture = mixed
    for key in EPISODES:
        expected = mixture.version_of("board", key.encode())
        assert version_for(client, key) == version_for(client, key, version="champion") == expected
    assert version_for(client, version="1") == 1, "other versions stay reachable"
    assert {version_for(client, key, version="4") for key in EPISODES} == {1, 3}, "the mixture by its number"
    versions = Counter(version_for(client) for _ in range(60))
    assert versions.keys() == {1, 3}
    assert 10 < versions[1] < 50, "requests without a key are distributed"


def test_the_response_names_the_version_that_acted(mixed: tuple[TestClient, Mixture]) -> None:
    client, _ = mixed
    rows = client.get("/v1/leagues/board/versions").json()["versions"]
    digests = {row["version"]: row["sha256"] for row in rows}
    for board in boards(20):
        answer = act(client, observation=board)
        expected = MEMBERS[answer["version"]].act(board_arrays([board])).actions[0]
        assert (answer["action"], answer["sha256"]) == (expected, digests[answer["version"]])


def test_descriptions_name_the_members(mixed: tuple[TestClient, Mixture]) -> None:
    client, _ = mixed
    members = [{"version": 1, "probability": 0.5}, {"version": 3, "probability": 0.5}]
    league = client.get("/v1/leagues/board").json()
    assert (league["champion"], league["mixtures"]) == (4, {"champion": members})
    versions = client.get("/v1/leagues/board/versions").json()["versions"]
    assert [row["members"] for row in versions] == [None, None, None, members]
    assert versions[3]["role"] == "mixture"
    until(lambda: value(client, "league_live_version", league="board", alias="champion") == 4)
    assert value(client, "league_mixture_probability", league="board", alias="champion", version="3") == 0.5


def test_a_local_policy_is_the_member_that_the_server_selects(client: TestClient, registry: Registry) -> None:
    mix(registry, {1: 0.5, 3: 0.5})
    arrays = board_arrays(boards(30))
    for key in EPISODES[:10]:
        local = load("board@champion", registry=registry, episode=key)
        expected = MEMBERS[version_for(client, key)].act(arrays).actions
        np.testing.assert_array_equal(local.act(arrays).actions, expected)
    with pytest.raises(InvalidInput, match=r"board@4 is a mixture \(@1 50.0 %, @3 50.0 %\)"):
        load("board@champion", registry=registry)


def test_an_episode_of_a_recurrent_member_stays_with_it(client: TestClient, registry: Registry) -> None:
    publish(registry, "memory", {"shared": counting()}, "run/2")
    mix(registry, {1: 0.5, 2: 0.5}, "memory")
    for version in (None, 3):  # the champion, and the number of the mixture
        members = set()
        for _ in range(20):
            answer = act(client, "memory", version, observation=[1.0])
            members.add(member := answer["version"])
            for _ in range(3):
                answer = act(client, "memory", version, observation=[1.0], state=answer["state"])
                assert answer["version"] == member
        assert members == {1, 2}
    error = rejected(
        client, {"observation": [1.0], "state": answer["state"]}, 400, "memory", params={"version": 3 - member}
    )
    assert error["code"] == "invalid_state"


def test_an_episode_continues_in_a_stream_whose_alias_is_not_recurrent_now(
    client: TestClient, registry: Registry
) -> None:
    publish(registry, "memory", {"shared": memoryless()}, "run/2")
    state = act(client, "memory", observation=[2.0])["state"]
    promote(registry, "memory", 2)
    registry.changes.wait_for_alias(registry.aliases.history("memory")[0], 30)
    with open_stream(client, "memory", "?follow=champion") as stream:
        answer = answer_to(stream, observation=[1.0], state=state, return_state=True)
        assert (answer["version"], answer["action"]) == (1, 1), "the sum of the episode exceeds 2"
        assert answer_to(stream, observation=[1.0], reset=True)["version"] == 2


def test_a_stream_continues_with_its_member_after_reconnecting(mixed: tuple[TestClient, Mixture]) -> None:
    (client, _), members = mixed, set()
    request = ActionRequest.build(BOARD, "lists")
    for _ in range(12):
        protocol = StreamProtocol(Endpoint("http://localhost", None, None, 5.0), parse_model("board"), follow=True)
        versions = []
        for connection in range(3):
            with open_stream(client, query="?" + protocol.url.partition("?")[2]) as stream:
                protocol.opened({"x-league-version": "1"})
                for reset in (connection == 0, False):
                    stream.send_text(protocol.message(request, reset))
                    protocol.receive(request, stream.receive_text())
                    versions.append(protocol.version)
        assert len(set(versions)) == 1
        members.add(versions[0])
    assert members == {1, 3}


def test_only_a_number_accompanies_follow(mixed: tuple[TestClient, Mixture]) -> None:
    """A version that is no member is ignored: the alias has moved."""
    client, _ = mixed
    with open_stream(client, query="?follow=champion&version=2") as stream:
        assert answer_to(stream, observation=BOARD)["version"] in (1, 3)
    query = "?follow=champion&version=champion"
    with pytest.raises(WebSocketDenialResponse) as refused, open_stream(client, query=query):
        pass
    assert refused.value.status_code == 400


def test_a_stream_changes_its_member_when_an_episode_starts(mixed: tuple[TestClient, Mixture]) -> None:
    client, mixture = mixed
    members = set()
    with open_stream(client, query="?follow=champion") as stream:
        for _ in range(20):
            first = answer_to(stream, observation=BOARD, reset=True)["version"]
            assert {answer_to(stream, observation=BOARD)["version"] for _ in range(4)} == {first}
            members.add(first)
    assert members == {1, 3}
    pinned = [("", {}, None), *(("?follow=champion", {"x_league_key": key}, key) for key in EPISODES[:6])]
    for query, headers, key in pinned:
        with open_stream(client, query=query, **headers) as stream:
            versions = {answer_to(stream, observation=BOARD, reset=True)["version"] for _ in range(20)}
        assert len(versions) == 1
        assert key is None or versions == {mixture.version_of("board", key.encode())}


def test_aliases_move_to_a_mixture_and_back(client: TestClient, registry: Registry) -> None:
    mix(registry, {1: 0.5, 3: 0.5})
    before = versions_by_key(client)
    assert set(before.values()) == {1, 3}
    mix(registry, {1: 0.5, 2: 0.5})
    after = versions_by_key(client)
    assert all((after[key] == 1) == (version == 1) for key, version in before.items()), "the others keep their member"
    event = registry.aliases.rollback("board", actor="test", reason="test")
    registry.changes.wait_for_alias(event, 30)
    assert versions_by_key(client) == before
    promote(registry, "board", 2)
    registry.changes.wait_for_alias(registry.aliases.history("board")[0], 30)
    assert set(versions_by_key(client).values()) == {2}


def test_a_mixture_is_a_canary_and_is_compared_with_a_shadow(client: TestClient, registry: Registry) -> None:
    number = registry.publisher.publish_mixture("board", {2: 0.5, 3: 0.5}).number
    setting = registry.traffic.set("board", canary=Portion(number, 0.5), actor="test", reason="test")
    registry.changes.wait_for_traffic(setting, 30)
    counts = Counter(versions_by_key(client).values())
    assert counts.keys() == {1, 2, 3}
    rows = client.get("/v1/leagues/board/traffic").json()["here"]["versions"]
    assert {row["version"]: row["as_canary"] for row in rows} == {1: 0, 2: counts[2], 3: counts[3]}
    setting = registry.traffic.set("board", canary=None, shadow=Portion(3, 1.0), actor="test", reason="test")
    mix(registry, {1: 0.5, 2: 0.5})
    registry.changes.wait_for_traffic(setting, 30)
    versions_by_key(client)
    until(
        lambda: {(one.candidate, one.champion) for one in registry.traffic.shadow_counts("board")} == {(3, 1), (3, 2)}
    )


def test_members_stay_loaded_and_a_mixture_with_a_damaged_one_is_not_served(registry: Registry) -> None:
    with replica(registry.storage, QUICK.model_copy(update={"cached_versions": 0})) as client:
        mix(registry, {2: 0.5, 3: 0.5})
        (registry.artifacts.path("board", 3) / "shared.onnx").write_bytes(b"damaged")
        assert version_for(client, version="3") == 3
    promote(registry, "board", 1)
    with replica(registry.storage) as client:
        promote(registry, "board", 4)
        until(lambda: client.get("/v1/leagues/board").json()["faults"])
        assert "board/3/shared.onnx" in client.get("/v1/leagues/board").json()["faults"][0]
        assert {version_for(client, key) for key in EPISODES[:10]} == {1}, "the champion before stays"


FULL = BOARD | {"observation": np.ones((6, 7, 2), int).tolist()}
"""The observation for which `endless_mlp` does not end."""


@pytest.fixture
def server(registry: Registry) -> Replica:
    # Otherwise the shadow pauses for nine times as long as a run that does not end.
    settings = QUICK.model_copy(update={"shadow_load": 0.5})
    return Replica(Registry.open(registry.storage), settings, "replica-1")


@pytest.fixture
def shadowed(server: Replica) -> Iterator[TestClient]:
    with local_client(server) as shadowed:
        yield shadowed


def test_agreement_equals_that_of_the_graphs(shadowed: TestClient, registry: Registry) -> None:
    set_shadow(registry)
    observations = boards(40)
    for board in observations[:20]:
        assert act(shadowed, observation=board)["version"] == 1
    for start in (20, 30):
        act(shadowed, observations=observations[start : start + 8])
    counts = wait_for(registry, lambda one: one.requests == 22)
    compared = observations[:28] + observations[30:38]
    first, second = (OnnxPolicy(masked_mlp(seed=seed)).act(board_arrays(compared)).actions for seed in (0, 1))
    assert (counts.candidate, counts.champion, counts.observations) == (2, 1, 36)
    assert 0 < counts.agreed == int((first == second).sum()) < 36
    assert (counts.failed, counts.dropped, counts.skipped) == (0, 0, 0)
    assert sum(counts.latency) == 22
    assert counts.ns > 0


def test_explored_requests_are_compared_by_greedy_actions_and_pinned_ones_are_not(
    shadowed: TestClient, registry: Registry
) -> None:
    promote(registry, "board", 3)
    until(lambda: act(shadowed, observation=BOARD)["version"] == 3)
    set_shadow(registry, version=1)
    observations = boards(20)
    for _ in range(5):
        act(shadowed, version=2, observation=BOARD)
    for board in observations:
        act(shadowed, observation=board, explore=True, seed=1)
    counts = wait_for(registry, lambda one: one.observations >= 20, candidate=1)
    third, first = (OnnxPolicy(masked_mlp(seed=seed)).act(board_arrays(observations)).actions for seed in (2, 0))
    assert (counts.observations, counts.agreed) == (20, int((third == first).sum()))


def test_state_of_another_network_is_not_mirrored(registry: Registry, shadowed: TestClient) -> None:
    publish(registry, "memory", {"shared": counting()}, "run/2")
    set_shadow(registry, league="memory")
    state = act(shadowed, "memory", observation=[1])["state"]
    act(shadowed, "memory", observation=[1], state=state)
    counts = wait_for(registry, lambda one: one.requests + one.skipped == 2, league="memory")
    assert (counts.requests, counts.agreed, counts.skipped) == (1, 1, 1)


def test_a_failing_candidate_is_counted_and_does_not_affect_requests(
    shadowed: TestClient, server: Replica, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_shadow(registry)
    monkeypatch.setattr(shadow_graph(server, 2), "act", Mock(side_effect=MemoryError("no room")))
    for _ in range(10):
        assert act(shadowed, observation=BOARD)["version"] == 1
    counts = wait_for(registry, lambda one: one.failed == 10)
    assert (counts.requests, counts.agreed) == (0, 0)


def shadow_graph(server: Replica, version: int) -> OnnxPolicy:
    """The policy of a version of `board` with which a shadow runs."""
    candidate = server.versions.cached("board", version)
    assert candidate is not None
    policy = candidate.policies["shared"].shadow_graph
    assert isinstance(policy, OnnxPolicy)
    return policy


def test_a_run_that_does_not_end_is_counted(
    shadowed: TestClient, server: Replica, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("serve_app.live_versions.policies.SHADOW_TIMEOUT", 0.1)
    endless = publish(registry, "board", {"shared": endless_mlp()}, "run/endless").number
    set_shadow(registry, version=endless)
    for _ in range(3):
        assert act(shadowed, observation=FULL)["version"] == 1
    counts = wait_for(registry, lambda one: one.failed == 3, candidate=endless)
    assert counts.requests == 0
    monkeypatch.setattr(shadow_graph(server, endless), "_timeout", 60.0)  # a busy machine may need more than 0.1 s
    act(shadowed, observation=BOARD)
    wait_for(registry, lambda one: one.requests == 1, candidate=endless)


def test_requests_for_a_former_shadow_are_dropped(
    shadowed: TestClient, server: Replica, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They may be slow, and those for another shadow wait for them."""
    set_shadow(registry)
    is_switched, act_of_shadow = Event(), shadow_graph(server, 2).act

    def slow_act(*args: Any, **kwargs: Any) -> Actions:
        is_switched.wait()
        return act_of_shadow(*args, **kwargs)

    monkeypatch.setattr(shadow_graph(server, 2), "act", slow_act)
    for _ in range(4):
        act(shadowed, observation=BOARD)
    until(lambda: server.shadow._queue.qsize() == 3)
    set_shadow(registry, version=3)
    act(shadowed, observation=BOARD)
    is_switched.set()
    assert wait_for(registry, lambda one: one.requests == 1, candidate=3).dropped == 0
    former = wait_for(registry, lambda one: one.dropped == 3)
    assert (former.requests, former.failed) == (1, 0)


async def replica_with_shadow(registry: Registry) -> tuple[Replica, LoadedPolicy]:
    """A replica whose queue of mirrored requests holds four, and its champion."""
    server = Replica(registry, QUICK.model_copy(update={"shadow_waiting": 4}), "replica-1")
    server.traffic.update({"board": registry.traffic.set("board", shadow=Portion(2, 1), actor="test", reason="test")})
    server.alias_slots.update({("board", "champion"): 1, ("board", "2"): 2})
    await server.alias_slots.settle(30)
    champion = server.alias_slots.champion("board")
    assert champion is not None
    return server, champion.policy(None)


async def wait_for_requests(shadow: Shadow, number: int) -> None:
    async with asyncio.timeout(60):
        while shadow.shadowings()[0].requests < number:
            await asyncio.sleep(0.001)


@pytest.mark.anyio
async def test_requests_beyond_the_limits_of_the_queue_are_dropped(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, champion = await replica_with_shadow(registry)
    mirror, observations = server.shadow.mirror_for(champion), board_arrays([BOARD])
    assert mirror is not None
    for _ in range(10):
        mirror(observations, None, np.array([0]))
    assert [one.dropped for one in server.shadow.shadowings()] == [6]
    with server.shadow.comparing():
        await wait_for_requests(server.shadow, 4)
    size = sum(array.nbytes for array in observations.values())
    monkeypatch.setattr("serve_app.live_versions.shadow.MAX_WAITING_BYTES", 2 * size)
    for _ in range(3):
        mirror(observations, None, np.array([0]))
    assert [one.dropped for one in server.shadow.shadowings()] == [7]
    with server.shadow.comparing():
        await wait_for_requests(server.shadow, 6)


@pytest.mark.anyio
async def test_a_share_of_one_half_mirrors_about_half(registry: Registry) -> None:
    server, champion = await replica_with_shadow(registry)
    half = registry.traffic.set("board", shadow=Portion(2, 0.5), actor="test", reason="test")
    server.traffic.update({"board": half})
    assert 350 < sum(server.shadow.mirror_for(champion) is not None for _ in range(1000)) < 650
