"""The action route: responses and errors."""

import asyncio
import gzip
import json
import threading
import zlib
from collections.abc import AsyncIterator
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient

from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Replica
from tests.support.clients.actions import BAD_BODIES, BOARD, act, boards, rejected
from tests.support.examples import examples
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.replicas import LOCALHOST, QUICK, READ_ONLY
from tests.support.waiting import until

ACTION = "/v1/policies/board/action"


def test_one_observation_gets_the_action_of_the_champion(read_only_client: TestClient, storage: Storage) -> None:
    registry = Registry.open(storage)
    policy = OnnxPolicy(masked_mlp(seed=0))
    for board in boards(20):
        expected = policy.act({name: np.array([value], np.int8) for name, value in board.items()})
        assert act(read_only_client, observation=board) == {
            "action": int(expected.actions[0]),
            "model": "board",
            "version": 1,
            "sha256": registry.versions.get("board", 1).sha256,
        }
    registry.close()


def test_a_batch_gets_the_actions_of_its_observations(read_only_client: TestClient) -> None:
    batch = boards(8)
    expected = [act(read_only_client, observation=board)["action"] for board in batch]
    assert act(read_only_client, observations=batch)["actions"] == expected
    assert len(set(expected)) > 1


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_version_can_be_selected_by_number(read_only_client: TestClient, version: int) -> None:
    policy = OnnxPolicy(masked_mlp(seed=version - 1))
    batch = boards(8)
    arrays = {name: np.array([board[name] for board in batch], np.int8) for name in BOARD}
    reply = act(read_only_client, version=version, observations=batch)
    assert (reply["version"], reply["actions"]) == (version, policy.act(arrays).actions.tolist())


@pytest.mark.parametrize(("encoding", "compress"), [("gzip", gzip.compress), ("deflate", zlib.compress)])
def test_a_compressed_body_is_accepted(read_only_client: TestClient, encoding: str, compress: Any) -> None:
    body = json.dumps({"observation": BOARD}).encode()
    reply = read_only_client.post(ACTION, content=compress(body), headers={"content-encoding": encoding})
    assert reply.json() == act(read_only_client, observation=BOARD)


@pytest.mark.parametrize(
    ("encoding", "body", "status", "message"),
    [
        ("br", b"{}", 415, "the Content-Encoding is 'br', expected gzip, deflate or identity"),
        ("gzip", b"{}", 400, "the body cannot be decompressed"),
        (
            "gzip",
            gzip.compress(bytes(READ_ONLY.max_body + 1), mtime=0),
            413,
            "the decompressed body is larger than 65536 bytes",
        ),
    ],
)
def test_a_body_that_cannot_be_decompressed_is_rejected(
    read_only_client: TestClient, encoding: str, body: bytes, status: int, message: str
) -> None:
    reply = read_only_client.post(ACTION, content=body, headers={"content-encoding": encoding})
    assert (reply.status_code, message in reply.json()["message"]) == (status, True), reply.text


@pytest.mark.parametrize(
    ("method", "path", "allowed", "expected"),
    [
        ("GET", ACTION, "POST", "POST"),
        ("DELETE", "/v1/leagues/board/traffic", "GET, HEAD, POST", "GET or POST"),
    ],
)
def test_another_method_is_refused_with_those_that_are_allowed(
    client: TestClient, registry: Registry, method: str, path: str, allowed: str, expected: str
) -> None:
    client.headers["x-api-key"] = registry.keys.create("all", ["act", "read", "promote"])[1]
    until(lambda: client.request(method, path).status_code != 401)
    reply = client.request(method, path)
    assert (reply.status_code, reply.headers["allow"]) == (405, allowed)
    assert reply.json()["message"] == f"{method} is not allowed for {path}: use {expected}"


def test_an_alias_selects_a_version(client: TestClient, registry: Registry) -> None:
    registry.aliases.set("board", "candidate", 3, expected=None, actor="test", reason="test")
    assert act(client, version="candidate", observation=BOARD)["version"] == 3
    assert act(client, version="champion", observation=BOARD)["version"] == 1


def test_the_response_names_the_replica(read_only_client: TestClient) -> None:
    reply = read_only_client.post("/v1/policies/board/action", json={"observation": BOARD})
    assert reply.headers["x-league-replica"] == "replica-1"


def test_a_league_with_several_policies_requires_one_of_them(read_only_client: TestClient) -> None:
    assert act(read_only_client, "duo.left", observation=BOARD)["model"] == "duo.left"
    error = rejected(read_only_client, {"observation": BOARD}, 404, "duo")
    assert error["code"] == "unknown_policy"
    assert "left, right" in error["message"]
    assert rejected(read_only_client, {"observation": BOARD}, 404, "duo.middle")["code"] == "unknown_policy"


def test_continuous_and_nested_spaces(read_only_client: TestClient) -> None:
    assert act(read_only_client, "vector", observation=[0.5, -1])["action"] == [0.5, -1.0]
    nested = {"mode": 2, "sense": {"speed": [0.5, 1]}}
    assert act(read_only_client, "nested", observation=nested)["action"] == 1
    nested["sense"] = {"speed": [0.5, -1]}
    assert act(read_only_client, "nested", observations=[nested])["actions"] == [0]


def test_state_can_be_sent_and_returned_as_arrays(read_only_client: TestClient) -> None:
    state: dict[str, Any] = {}
    actions = []
    for _ in range(4):
        reply = act(read_only_client, "memory", observation=[1], state=state)
        state = reply["state"]
        actions.append(reply["action"])
    assert (actions, state) == ([0, 0, 1, 1], {"state_in_0": [[4.0]]})
    assert rejected(read_only_client, {"observation": [1], "state": {"state_in_0": [[1], [2]]}}, model="memory")
    assert rejected(read_only_client, {"observation": [1], "state": {"other": 1}}, model="memory")
    assert "state" not in act(read_only_client, observation=BOARD, state={})
    error = rejected(read_only_client, {"observation": BOARD, "state": {"state_in_0": [[1]]}})
    assert (error["code"], "not recurrent" in error["message"]) == ("invalid_state", True)


def test_exploring_with_a_seed_is_reproducible(read_only_client: TestClient) -> None:
    board = boards(1)[0]
    draws = [act(read_only_client, observation=board, explore=True, seed=seed)["action"] for seed in range(60)]
    assert draws == [act(read_only_client, observation=board, explore=True, seed=seed)["action"] for seed in range(60)]
    legal = {action for action, allowed in enumerate(board["action_mask"]) if allowed}
    assert set(draws) == legal
    assert draws[:8] == act(read_only_client, observations=[board] * 8, explore=True, seed=list(range(8)))["actions"]


def test_exploring_without_a_seed_varies(read_only_client: TestClient) -> None:
    assert len({act(read_only_client, observation=BOARD, explore=True)["action"] for _ in range(60)}) > 1


def test_draws_of_a_batch_with_one_seed_depend_on_the_row_only(read_only_client: TestClient) -> None:
    long = act(read_only_client, observations=[BOARD] * 8, explore=True, seed=7)["actions"]
    assert act(read_only_client, observations=[BOARD] * 3, explore=True, seed=7)["actions"] == long[:3]
    assert len(set(long)) > 1


@pytest.mark.parametrize("name", BAD_BODIES)
def test_an_invalid_body_is_rejected(read_only_client: TestClient, name: str) -> None:
    body, code, message = BAD_BODIES[name]
    error = rejected(read_only_client, body)
    assert error["code"] == code
    assert message in error["message"]


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b'{"observation": [1e999, 0]}', "finite"),
        ({"observation": [1, 2, 3]}, "expected [2]"),
        ({"observation": {"observation": [1, 2], "action_mask": [1]}}, "values that are not numbers"),
    ],
)
def test_an_invalid_vector_is_rejected(read_only_client: TestClient, body: Any, message: str) -> None:
    error = rejected(read_only_client, body, model="vector")
    assert error["code"] in ("invalid_observation", "malformed_body")
    assert message in error["message"] or "JSON" in error["message"]


def test_a_discrete_observation_must_be_in_range(read_only_client: TestClient) -> None:
    error = rejected(read_only_client, {"observation": {"mode": 4, "sense": {"speed": [1, 1]}}}, model="nested")
    assert "observation.mode must be between 1 and 3" in error["message"]
    error = rejected(read_only_client, {"observation": {"mode": 1, "sense": [1, 1]}}, model="nested")
    assert "observation.sense is a list" in error["message"]


def test_a_continuous_policy_explores_reproducibly(read_only_client: TestClient) -> None:
    def explored(seed: int) -> list[float]:
        body = {"observation": [0, 0], "explore": True, "seed": seed}
        return read_only_client.post("/v1/policies/vector/action", json=body).json()["action"]

    assert explored(5) == explored(5) != explored(6)


@pytest.mark.parametrize(
    ("path", "status", "code"),
    [
        ("/v1/policies/nobody/action", 404, "unknown_league"),
        ("/v1/policies/Board/action", 400, "invalid_reference"),
        ("/v1/policies/board..x/action", 400, "invalid_reference"),
        ("/v1/policies/board.other/action", 404, "unknown_policy"),
        ("/v1/policies/board/action?version=99", 404, "unknown_version"),
        ("/v1/policies/board/action?version=0", 400, "invalid_reference"),
        ("/v1/policies/board/action?version=99999999999999999999", 400, "invalid_reference"),
        ("/v1/policies/board/action?version=rival", 404, "unknown_alias"),
        ("/v1/policies/board/action?version=", 400, "invalid_reference"),
        ("/v1/policies/board/action?version=%00", 400, "invalid_reference"),
        ("/v1/policies/board/act", 404, "unknown_path"),
        ("/v1/policies//action", 404, "unknown_path"),
        ("/", 405, "method_not_allowed"),
    ],
)
def test_unknown_resources_are_reported(read_only_client: TestClient, path: str, status: int, code: str) -> None:
    reply = read_only_client.post(path, json={"observation": BOARD})
    assert (reply.status_code, reply.json()["code"]) == (status, code)


@pytest.mark.parametrize("league", ["empty", "headless"])
def test_a_league_without_a_champion_is_not_ready(read_only_client: TestClient, league: str) -> None:
    reply = read_only_client.post(f"/v1/policies/{league}/action", json={"observation": BOARD})
    assert (reply.status_code, reply.json()["code"]) == (503, "not_ready")
    assert int(reply.headers["retry-after"]) >= 1


def test_a_version_of_a_league_without_a_champion_answers(read_only_client: TestClient) -> None:
    assert act(read_only_client, "headless", version=1, observation=BOARD)["version"] == 1


@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE", "PATCH", "HEAD", "OPTIONS"])
def test_another_method_is_rejected(read_only_client: TestClient, method: str) -> None:
    reply = read_only_client.request(method, "/v1/policies/board/action")
    assert (reply.status_code, reply.headers["allow"]) == (405, "POST")
    assert method == "HEAD" or reply.json()["code"] == "method_not_allowed"


@pytest.mark.parametrize("media_type", ["image/png", "multipart/form-data; boundary=x", "text/html", "nonsense"])
def test_another_media_type_is_rejected(read_only_client: TestClient, media_type: str) -> None:
    error = rejected(read_only_client, {"observation": BOARD}, 415, headers={"content-type": media_type})
    assert error["code"] == "unsupported_media_type"


@pytest.mark.parametrize("media_type", ["application/json; charset=utf-8", "application/x-www-form-urlencoded"])
def test_usual_media_types_of_clients_are_accepted(read_only_client: TestClient, media_type: str) -> None:
    reply = read_only_client.post(
        "/v1/policies/board/action",
        content=json.dumps({"observation": BOARD}),
        headers={"content-type": media_type},
    )
    assert reply.status_code == 200


def test_a_large_body_is_rejected(read_only_client: TestClient) -> None:
    error = rejected(read_only_client, b" " * (64 * 1024 + 1), 413)
    assert error["code"] == "body_too_large"
    in_parts = (b" " * 1024 for _ in range(65))  # without Content-Length
    assert rejected(read_only_client, None, 413, content=in_parts)["code"] == "body_too_large"


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("path", "document", "handler"),
    [
        (ACTION, {"observation": BOARD}, "action"),
        (
            "/v2/models/vector/infer",
            {"inputs": [{"name": "observation", "datatype": "FP32", "shape": [1, 2], "data": [0.5, -1]}]},
            "inference",
        ),
    ],
)
async def test_the_number_of_concurrent_requests_is_limited(
    registry: Registry, path: str, document: dict[str, Any], handler: str
) -> None:
    server = Replica(registry, QUICK.model_copy(update={"max_in_flight": 2}), "replica-1")
    resume = asyncio.Event()

    async def body() -> AsyncIterator[bytes]:
        await resume.wait()
        yield json.dumps(document).encode()

    transport = httpx.ASGITransport(server.application())
    async with server.watcher.watching(), httpx.AsyncClient(transport=transport, base_url=LOCALHOST) as client:
        slow = [asyncio.create_task(client.post(path, content=body())) for _ in range(2)]
        while getattr(server, handler).in_flight < 2:
            await asyncio.sleep(0)
        reply = await client.post(path, json=document)
        assert (reply.status_code, reply.headers["retry-after"]) == (429, "1")
        assert (await client.get("/v1/leagues")).status_code == 200
        resume.set()
        assert [(await each).status_code for each in slow] == [200, 200]
        assert (await client.post(path, json=document)).status_code == 200


@pytest.mark.anyio
async def test_the_number_of_other_concurrent_requests_is_limited(registry: Registry) -> None:
    server = Replica(registry, QUICK.model_copy(update={"max_in_flight": 2}), "replica-1")
    resume = threading.Event()
    transport = httpx.ASGITransport(server.application())
    async with server.watcher.watching(), httpx.AsyncClient(transport=transport, base_url=LOCALHOST) as client:
        blocked = [asyncio.create_task(server.models.in_registry_thread(lambda _: resume.wait(60))) for _ in range(4)]
        slow = [asyncio.create_task(client.get("/v1/leagues")) for _ in range(3)]
        refused, _ = await asyncio.wait(slow, return_when=asyncio.FIRST_COMPLETED)
        (reply,) = [request.result() for request in refused]
        assert (reply.status_code, reply.json()["code"]) == (429, "overloaded")
        assert (await client.get("/v1/health/live")).status_code == 200
        assert (await client.post("/v1/policies/board/action", json={"observation": BOARD})).status_code == 200
        resume.set()
        await asyncio.gather(*blocked)
        assert sorted([(await request).status_code for request in slow]) == [200, 200, 429]


def test_strings_do_not_use_memory(read_only_client: TestClient) -> None:
    """NumPy would make each of these 1,000 strings as wide as the longest one: 16 MB."""
    rejected(read_only_client, {"observation": ["x" * 4_000] + [""] * 1_000}, model="vector")


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=20,
)
near_misses = st.fixed_dictionaries(
    {},
    optional={
        "observation": json_values
        | st.fixed_dictionaries(
            {
                "observation": json_values | st.just(BOARD["observation"]),
                "action_mask": json_values | st.lists(st.integers(-1, 2), min_size=6, max_size=8),
            }
        ),
        "observations": json_values | st.lists(json_values | st.just(BOARD), max_size=10),
        "state": st.none() | json_values,
        "explore": st.booleans() | json_values,
        "seed": st.integers(-1, 2**64) | json_values,
        "extra": json_values,
    },
)


@examples(400)
@given(
    body=st.binary(max_size=60) | near_misses.map(lambda body: json.dumps(body).encode()),
    model=st.sampled_from(["board", "vector", "nested", "memory", "duo", "duo.left"]) | st.text(max_size=10),
    version=st.sampled_from(["", "1", "champion"]) | st.text(max_size=10),
)
def test_no_input_causes_a_server_error(read_only_client: TestClient, body: bytes, model: str, version: str) -> None:
    url = f"/v1/policies/{quote(model, safe='')}/action?version={quote(version, safe='')}"
    reply = read_only_client.post(url, content=body)
    assert reply.status_code < 500 or (reply.status_code, reply.json()["code"]) == (503, "not_ready")
    if reply.status_code == 200:
        assert "code" not in reply.json()
    else:
        assert reply.json().keys() == {"code", "message"}
