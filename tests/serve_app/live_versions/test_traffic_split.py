"""Canaries: which version answers which key, and how canaries are set and moved while a replica runs."""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient

from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from serve_app.live_versions.traffic_split import key_position
from tests.support.clients.actions import BOARD
from tests.support.leagues.served_leagues import promote
from tests.support.servers.replicas import replica
from tests.support.waiting import until

TRAFFIC = "/v1/leagues/board/traffic"
KEYS = [f"player-{number}" for number in range(200)]


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


def version_for(client: TestClient, key: str | None = None, version: str | None = None) -> int:
    reply = client.post(
        "/v1/policies/board/action",
        json={"observation": BOARD},
        headers={} if key is None else {"x-league-key": key},
        params={} if version is None else {"version": version},
    )
    assert reply.status_code == 200, reply.text
    return int(reply.json()["version"])


def versions_by_key(client: TestClient) -> dict[str, int]:
    return {key: version_for(client, key) for key in KEYS}


def set_traffic(registry: Registry, **portions: Any) -> Callable[[], bool]:
    """Set traffic; returns a function that tells whether the replica follows it."""
    setting = registry.traffic.set("board", **portions, actor="test", reason="test")
    return lambda: [one.traffic for one in registry.replicas.acknowledgements("board")] == [setting.id]


def test_a_canary_answers_its_share_of_keys(client: TestClient, registry: Registry) -> None:
    until(set_traffic(registry, canary=Portion(2, 0.25)))
    quarter = versions_by_key(client)
    assert 20 < Counter(quarter.values())[2] < 80
    assert versions_by_key(client) == quarter, "each key keeps its version"
    until(set_traffic(registry, canary=Portion(2, 0.5)))
    half = versions_by_key(client)
    assert all(half[key] == 2 for key, version in quarter.items() if version == 2)
    assert Counter(half.values())[2] > Counter(quarter.values())[2]
    until(set_traffic(registry, canary=None))
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
    body = {
        "inputs": [
            {"name": "observation", "shape": [1, 6, 7, 2], "datatype": "INT8", "data": [0] * 84},
            {"name": "action_mask", "shape": [1, 7], "datatype": "INT8", "data": [1] * 7},
        ]
    }
    for key in KEYS[:20]:
        reply = client.post("/v2/models/board/infer", json=body, headers={"x-league-key": key})
        assert int(reply.json()["model_version"]) == version_for(client, key)


@pytest.fixture
def promoter(registry: Registry) -> Iterator[TestClient]:
    _, token = registry.keys.create("release-bot", ["promote", "read", "act"])
    with replica(registry.storage) as client:
        client.headers["authorization"] = f"Bearer {token}"
        yield client


def change(client: TestClient, body: Any, key: str = "a", status: int = 200) -> dict[str, Any]:
    reply = client.post(TRAFFIC, content=json.dumps(body), headers={"idempotency-key": key})
    assert reply.status_code == status, reply.text
    return reply.json()


def test_traffic_is_set_over_http(promoter: TestClient, registry: Registry) -> None:
    body = {"canary": {"version": 2, "share": 0.05}, "reason": "try it"}
    response = change(promoter, body)
    assert (response["canary"], response["shadow"]) == ({"version": 2, "share": 0.05}, None)
    assert (response["actor"], response["reason"]) == ("release-bot", "try it")
    assert change(promoter, body) == response, "a repeated call has the same response"
    assert change(promoter, {"shadow": {"version": "3", "share": 1}}, "b")["canary"] == response["canary"], (
        "the canary remains"
    )
    both = change(promoter, {"canary": None, "shadow": None}, "c")
    assert (both["canary"], both["shadow"]) == (None, None)
    assert [one.canary and one.canary.share for one in registry.traffic.history("board")] == [None, 0.05, 0.05]
    until(lambda: promoter.get(TRAFFIC).json()["replicas"][0]["follows"])


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        ({"canary": {"version": 9, "share": 0.1}}, 404, "unknown_version"),
        ({"canary": {"version": "nobody", "share": 0.1}}, 404, "unknown_alias"),
        ({"canary": {"version": "champion", "share": 0.1}}, 400, "invalid_input"),
        ({"canary": {"version": 2, "share": 1.1}}, 400, "invalid_input"),
        ({"canary": {"version": 2}}, 400, "invalid_input"),
        ({"canary": {"version": 0, "share": 0.1}}, 400, "invalid_input"),
        ({"canary": {"version": True, "share": 0.1}}, 400, "invalid_input"),
        ({"canarie": None}, 400, "invalid_input"),
    ],
)
def test_invalid_traffic_is_rejected(
    promoter: TestClient, registry: Registry, body: Any, status: int, code: str
) -> None:
    assert change(promoter, body, status=status)["code"] == code
    assert registry.traffic.current("board").id is None


def test_setting_traffic_always_requires_a_key(client: TestClient) -> None:
    assert client.get(TRAFFIC).status_code == 200
    assert client.post(TRAFFIC, json={"canary": None}, headers={"idempotency-key": "a"}).status_code == 401


def test_a_promoted_canary_is_the_champion(client: TestClient, registry: Registry) -> None:
    until(set_traffic(registry, canary=Portion(2, 0.5)))
    promote(registry, "board", 2)
    until(lambda: version_for(client) == 2)
    assert set(versions_by_key(client).values()) == {2}
