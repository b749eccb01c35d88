"""A mixture in a replica: who answers which key, what responses name, streams, hot swaps and faults."""

import json
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient, WebSocketDenialResponse, WebSocketTestSession

from league.errors import InvalidInput
from league.policies.loading import load
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.registry.storage.manifest import Mixture
from league.registry.storage.rows import Portion
from league.settings import Storage
from policy_league_client.endpoint import Endpoint
from policy_league_client.requests import ActionRequest
from policy_league_client.responses import parse_model
from policy_league_client.stream_protocol import StreamProtocol
from tests.support.clients.actions import BOARD, act, boards
from tests.support.leagues.served_leagues import everything, promote, publish
from tests.support.policies.graphs import counting, masked_mlp, memoryless
from tests.support.servers.exposition import value
from tests.support.servers.replicas import QUICK, READ_ONLY, replica
from tests.support.waiting import until

KEYS = [f"episode-{number}" for number in range(24)]


def version_for(client: TestClient, key: str | None = None, version: str | None = None) -> int:
    headers = {} if key is None else {"x-league-key": key}
    params = {} if version is None else {"version": version}
    reply = client.post("/v1/policies/board/action", json={"observation": BOARD}, headers=headers, params=params)
    assert reply.status_code == 200, reply.text
    return int(reply.json()["version"])


def open_stream(client: TestClient, query: str = "", **headers: str) -> WebSocketTestSession:
    return client.websocket_connect(f"/v1/policies/board/stream{query}", headers=headers)


def answer_to(stream: WebSocketTestSession, **message: Any) -> dict[str, Any]:
    stream.send_text(json.dumps(message))
    answer = json.loads(stream.receive_text())
    assert "code" not in answer, answer
    return answer


def versions_by_key(client: TestClient) -> dict[str, int]:
    return {key: version_for(client, key) for key in KEYS}


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


@given(st.text(st.characters(codec="ascii", categories=["L", "N"]), min_size=1, max_size=40))
@settings(max_examples=20, deadline=None)
def test_a_key_selects_its_member(mixed: tuple[TestClient, Mixture], key: str) -> None:
    client, mixture = mixed
    expected = mixture.version_of("board", key.encode())
    assert version_for(client, key) == version_for(client, key, version="champion") == expected


def test_the_response_names_the_version_that_acted(mixed: tuple[TestClient, Mixture]) -> None:
    client, _ = mixed
    graphs = {1: OnnxPolicy(masked_mlp(seed=0)), 3: OnnxPolicy(masked_mlp(seed=2))}
    digests = {each["version"]: each["sha256"] for each in client.get("/v1/leagues/board/versions").json()["versions"]}
    for board in boards(20):
        answer = act(client, observation=board)
        expected = graphs[answer["version"]].act({name: np.array([row], np.int8) for name, row in board.items()})
        assert (answer["action"], answer["sha256"]) == (expected.actions[0], digests[answer["version"]])


def test_requests_without_a_key_are_distributed(mixed: tuple[TestClient, Mixture]) -> None:
    client, _ = mixed
    found = Counter(version_for(client) for _ in range(60))
    assert found.keys() == {1, 3}
    assert 10 < found[1] < 50


def test_other_versions_stay_reachable(mixed: tuple[TestClient, Mixture]) -> None:
    client, _ = mixed
    assert version_for(client, version="1") == 1
    assert {version_for(client, key, version="4") for key in KEYS[:20]} == {1, 3}, "the mixture by its number"


def test_descriptions_name_the_members(mixed: tuple[TestClient, Mixture]) -> None:
    client, _ = mixed
    members = [{"version": 1, "probability": 0.5}, {"version": 3, "probability": 0.5}]
    league = client.get("/v1/leagues/board").json()
    assert (league["champion"], league["mixtures"]) == (4, {"champion": members})
    versions = client.get("/v1/leagues/board/versions").json()["versions"]
    assert [each["members"] for each in versions] == [None, None, None, members]
    assert versions[3]["role"] == "mixture"
    until(lambda: value(client, "league_live_version", league="board", alias="champion") == 4)


def test_requests_are_counted_by_member(client: TestClient, registry: Registry) -> None:
    mix(registry, {1: 0.5, 3: 0.5})
    answered = Counter(version_for(client, key) for key in KEYS)
    for version, count in answered.items():
        until(lambda v=version, c=count: value(client, "league_request_seconds_count", version=str(v)) == c)
    assert value(client, "league_mixture_probability", league="board", alias="champion", version="3") == 0.5


def test_a_local_policy_is_the_member_that_the_server_selects(client: TestClient, registry: Registry) -> None:
    mix(registry, {1: 0.5, 3: 0.5})
    graphs = {1: OnnxPolicy(masked_mlp(seed=0)), 3: OnnxPolicy(masked_mlp(seed=2))}
    arrays = {name: np.array([row[name] for row in boards(30)], np.int8) for name in BOARD}
    for key in KEYS[:10]:
        loaded = load("board@champion", registry=registry, episode=key)
        expected = graphs[version_for(client, key)].act(arrays).actions
        np.testing.assert_array_equal(loaded.act(arrays).actions, expected)
    with pytest.raises(InvalidInput, match=r"board@4 is a mixture \(@1 50.0 %, @3 50.0 %\)"):
        load("board@champion", registry=registry)


def test_an_episode_of_a_recurrent_member_stays_with_it(client: TestClient, registry: Registry) -> None:
    publish(registry, "memory", {"shared": counting()}, "run/2")
    mix(registry, {1: 0.5, 2: 0.5}, "memory")
    seen = set()
    for _ in range(20):
        first = act(client, "memory", observation=[1.0])
        seen.add(first["version"])
        state = first["state"]
        for _ in range(3):
            answer = act(client, "memory", observation=[1.0], state=state)
            assert answer["version"] == first["version"]
            state = answer["state"]
    assert seen == {1, 2}


def test_an_episode_continues_with_the_number_of_its_mixture(client: TestClient, registry: Registry) -> None:
    publish(registry, "memory", {"shared": counting()}, "run/2")
    number = registry.publisher.publish_mixture("memory", {1: 0.5, 2: 0.5}).number
    for _ in range(6):
        first = act(client, "memory", observation=[1.0], version=str(number))
        answer = act(client, "memory", observation=[1.0], version=str(number), state=first["state"])
        assert answer["version"] == first["version"]
    body = {"observation": [1.0], "state": first["state"]}
    other = client.post("/v1/policies/memory/action", json=body, params={"version": str(3 - first["version"])})
    assert (other.status_code, other.json()["code"]) == (400, "invalid_state")


def test_an_episode_continues_in_a_stream_whose_alias_is_not_recurrent_now(
    client: TestClient, registry: Registry
) -> None:
    publish(registry, "memory", {"shared": memoryless()}, "run/2")
    state = act(client, "memory", observation=[2.0])["state"]
    promote(registry, "memory", 2)
    registry.changes.wait_for_alias(registry.aliases.history("memory")[0], 30)
    with client.websocket_connect("/v1/policies/memory/stream?follow=champion") as stream:
        answer = answer_to(stream, observation=[1.0], state=state, return_state=True)
        assert (answer["version"], answer["action"]) == (1, 1), "the sum of the episode exceeds 2"
        assert answer_to(stream, observation=[1.0], reset=True)["version"] == 2


def test_a_stream_continues_with_its_member_after_reconnecting(client: TestClient, registry: Registry) -> None:
    mix(registry, {1: 0.5, 3: 0.5})
    request, members = ActionRequest.build(BOARD, "lists"), set()
    for _ in range(12):
        protocol = StreamProtocol(Endpoint("http://localhost", None, None, 5.0), parse_model("board"), follow=True)
        seen = []
        for connection in range(3):
            with open_stream(client, query="?" + protocol.url.partition("?")[2]) as stream:
                protocol.opened({"x-league-version": "1"})
                for reset in (connection == 0, False):
                    stream.send_text(protocol.message(request, reset))
                    protocol.receive(request, stream.receive_text())
                    seen.append(protocol.version)
        assert len(set(seen)) == 1
        members.add(seen[0])
    assert members == {1, 3}


@pytest.mark.parametrize(("query", "status"), [("version=champion", 400), ("version=2", 101)])
def test_only_a_number_accompanies_follow(client: TestClient, registry: Registry, query: str, status: int) -> None:
    """A version that is no member is ignored: the alias has moved."""
    mix(registry, {1: 0.5, 3: 0.5})
    if status == 101:
        with open_stream(client, query=f"?follow=champion&{query}") as stream:
            assert answer_to(stream, observation=BOARD)["version"] in (1, 3)
    else:
        with pytest.raises(WebSocketDenialResponse) as refused, open_stream(client, query=f"?follow=champion&{query}"):
            pass
        assert refused.value.status_code == status


def test_a_stream_changes_its_member_when_an_episode_starts(client: TestClient, registry: Registry) -> None:
    mix(registry, {1: 0.5, 3: 0.5})
    seen = set()
    with open_stream(client, query="?follow=champion") as stream:
        for _ in range(20):
            first = answer_to(stream, observation=BOARD, reset=True)["version"]
            assert {answer_to(stream, observation=BOARD)["version"] for _ in range(4)} == {first}
            seen.add(first)
    assert seen == {1, 3}
    with open_stream(client) as stream:
        assert len({answer_to(stream, observation=BOARD, reset=True)["version"] for _ in range(20)}) == 1


def test_the_key_of_a_stream_selects_its_member(client: TestClient, registry: Registry) -> None:
    mixture = mix(registry, {1: 0.5, 3: 0.5})
    for key in KEYS[:6]:
        with open_stream(client, query="?follow=champion", **{"x-league-key": key}) as stream:
            found = {answer_to(stream, observation=BOARD, reset=True)["version"] for _ in range(5)}
        assert found == {mixture.version_of("board", key.encode())}


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
    found = Counter(versions_by_key(client).values())
    assert found.keys() == {1, 2, 3}
    shown = client.get("/v1/leagues/board/traffic").json()["here"]["versions"]
    assert {each["version"]: each["as_canary"] for each in shown} == {1: 0, 2: found[2], 3: found[3]}
    setting = registry.traffic.set("board", canary=None, shadow=Portion(3, 1.0), actor="test", reason="test")
    mix(registry, {1: 0.5, 2: 0.5})
    registry.changes.wait_for_traffic(setting, 30)
    versions_by_key(client)
    until(
        lambda: {(one.candidate, one.champion) for one in registry.traffic.shadow_counts("board")} == {(3, 1), (3, 2)}
    )


def test_a_mixture_whose_member_is_damaged_is_not_served(registry: Registry) -> None:
    (registry.artifacts.path("board", 3) / "shared.onnx").write_bytes(b"damaged")
    number = registry.publisher.publish_mixture("board", {2: 0.5, 3: 0.5}).number
    with replica(registry.storage, QUICK) as client:
        promote(registry, "board", number)
        until(lambda: client.get("/v1/leagues/board").json()["faults"])
        assert "board/3/shared.onnx" in client.get("/v1/leagues/board").json()["faults"][0]
        assert {version_for(client, key) for key in KEYS[:10]} == {1}, "the champion before stays"


def test_members_stay_loaded_with_their_mixture(registry: Registry) -> None:
    with replica(registry.storage, QUICK.model_copy(update={"cached_versions": 0})) as client:
        mix(registry, {2: 0.5, 3: 0.5})
        registry.artifacts.path("board", 3).rename(registry.artifacts.path("board", 3).with_name("gone"))
        assert version_for(client, version="3") == 3
