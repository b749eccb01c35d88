"""Canaries: who answers whom, and how they are set and moved while a replica runs."""

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
from league.registry.rows import Portion
from serve_app.traffic import position
from tests.serve_app.conftest import replica
from tests.serve_app.leagues import promote
from tests.serve_app.test_action import BOARD
from tests.serve_app.test_alias_watcher import until

TRAFFIC = "/v1/leagues/board/traffic"
KEYS = [f"player-{number}" for number in range(200)]


@given(st.binary(), st.floats(0, 1), st.floats(0, 1))
def test_a_greater_share_only_adds_keys(key: bytes, share: float, other: float) -> None:
    assert 0 <= (at := position("board", key)) < 1
    less, more = sorted((share, other))
    assert not (at < less and at >= more)


def test_keys_are_spread_evenly_and_differently_in_each_league() -> None:
    positions = [position("board", key.encode()) for key in KEYS]
    assert 60 < sum(at < 0.5 for at in positions) < 140
    assert positions != [position("duo", key.encode()) for key in KEYS]
    assert position("board", b"player-0") == 0.47714954489280714, "the same on every replica, in every release"


def answers(client: TestClient, key: str | None = None, version: str | None = None) -> int:
    reply = client.post(
        "/v1/policies/board/action",
        json={"observation": BOARD},
        headers={} if key is None else {"x-league-key": key},
        params={} if version is None else {"version": version},
    )
    assert reply.status_code == 200, reply.text
    return int(reply.json()["version"])


def sides(client: TestClient) -> dict[str, int]:
    return {key: answers(client, key) for key in KEYS}


def put(registry: Registry, **portions: Any) -> Callable[[], bool]:
    """Set traffic; returns whether the replica follows it."""
    setting = registry.set_traffic("board", **portions, actor="test", reason="test")
    return lambda: [one.traffic for one in registry.acknowledgements("board")] == [setting.id]


def test_a_canary_answers_its_share_of_keys(client: TestClient, registry: Registry) -> None:
    until(put(registry, canary=Portion(2, 0.25)))
    quarter = sides(client)
    assert 20 < Counter(quarter.values())[2] < 80
    assert sides(client) == quarter, "each key stays on its side"
    until(put(registry, canary=Portion(2, 0.5)))
    half = sides(client)
    assert all(half[key] == 2 for key, version in quarter.items() if version == 2)
    assert Counter(half.values())[2] > Counter(quarter.values())[2]
    until(put(registry, canary=None))
    assert set(sides(client).values()) == {1}


def test_without_a_key_or_with_a_version_there_is_no_canary(client: TestClient, registry: Registry) -> None:
    until(put(registry, canary=Portion(2, 1.0)))
    assert answers(client, "anybody") == 2
    assert answers(client) == 1
    assert answers(client, "anybody", version="champion") == 2
    assert answers(client, "anybody", version="1") == 1


def test_a_canary_by_alias_moves_with_it(client: TestClient, registry: Registry) -> None:
    registry.set_alias("board", "candidate", 2, expected=ANY, actor="test", reason="test")
    until(put(registry, canary=Portion("candidate", 1.0)))
    assert answers(client, "anybody") == 2
    registry.set_alias("board", "candidate", 3, expected=ANY, actor="test", reason="test")
    until(lambda: answers(client, "anybody") == 3)


def test_a_canary_that_cannot_be_loaded_answers_nobody(client: TestClient, registry: Registry) -> None:
    (registry.artifacts.path("board", 2) / "shared.onnx").write_bytes(b"tampered")
    follows = put(registry, canary=Portion(2, 1.0))
    until(lambda: any(said.fault for said in registry.acknowledgements("board")))
    assert answers(client, "anybody") == 1
    assert not follows()
    assert "2: " in str(registry.acknowledgements("board")[0].fault)


def test_inference_has_the_same_canary(client: TestClient, registry: Registry) -> None:
    until(put(registry, canary=Portion(2, 0.5)))
    body = {
        "inputs": [
            {"name": "observation", "shape": [1, 6, 7, 2], "datatype": "INT8", "data": [0] * 84},
            {"name": "action_mask", "shape": [1, 7], "datatype": "INT8", "data": [1] * 7},
        ]
    }
    for key in KEYS[:20]:
        reply = client.post("/v2/models/board/infer", json=body, headers={"x-league-key": key})
        assert int(reply.json()["model_version"]) == answers(client, key)


@pytest.fixture
def promoter(registry: Registry) -> Iterator[TestClient]:
    _, token = registry.create_key("release-bot", ["promote", "read", "act"])
    with replica(registry.storage) as client:
        client.headers["authorization"] = f"Bearer {token}"
        yield client


def change(client: TestClient, body: Any, key: str = "a", status: int = 200) -> dict[str, Any]:
    reply = client.post(TRAFFIC, content=json.dumps(body), headers={"idempotency-key": key})
    assert reply.status_code == status, reply.text
    return reply.json()


def test_traffic_is_set_over_http(promoter: TestClient, registry: Registry) -> None:
    body = {"canary": {"version": 2, "share": 0.05}, "reason": "try it"}
    done = change(promoter, body)
    assert (done["canary"], done["shadow"]) == ({"version": 2, "share": 0.05}, None)
    assert (done["actor"], done["reason"]) == ("release-bot", "try it")
    assert change(promoter, body) == done, "a repetition gets the same answer"
    assert change(promoter, {"shadow": {"version": "3", "share": 1}}, "b")["canary"] == done["canary"], "it stays"
    both = change(promoter, {"canary": None, "shadow": None}, "c")
    assert (both["canary"], both["shadow"]) == (None, None)
    assert [one.canary and one.canary.share for one in registry.traffic_history("board")] == [None, 0.05, 0.05]
    until(lambda: promoter.get(TRAFFIC).json()["replicas"][0]["follows"])


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        ({"canary": {"version": 9, "share": 0.1}}, 404, "unknown_version"),
        ({"canary": {"version": "nobody", "share": 0.1}}, 404, "unknown_alias"),
        ({"canary": {"version": "champion", "share": 0.1}}, 400, "invalid_input"),
        ({"canary": {"version": 2, "share": 1.1}}, 400, "invalid_input"),
        ({"canary": {"version": 2}}, 400, "invalid_input"),
        ({"canary": {"version": 0, "share": 0.1}}, 400, "invalid_reference"),
        ({"canary": {"version": True, "share": 0.1}}, 400, "invalid_input"),
        ({"canarie": None}, 400, "invalid_input"),
    ],
)
def test_what_is_wrong_is_refused(promoter: TestClient, registry: Registry, body: Any, status: int, code: str) -> None:
    assert change(promoter, body, status=status)["code"] == code
    assert registry.traffic("board").id is None


def test_setting_traffic_takes_a_key_even_where_nothing_else_does(client: TestClient) -> None:
    assert client.get(TRAFFIC).status_code == 200
    assert client.post(TRAFFIC, json={"canary": None}, headers={"idempotency-key": "a"}).status_code == 401


def test_a_promoted_canary_is_the_champion(client: TestClient, registry: Registry) -> None:
    until(put(registry, canary=Portion(2, 0.5)))
    promote(registry, "board", 2)
    until(lambda: answers(client) == 2)
    assert set(sides(client).values()) == {2}
