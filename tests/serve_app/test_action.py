"""The action route: what it answers, and what it refuses."""

import asyncio
import copy
import json
from collections.abc import AsyncIterator
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient

from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Server
from tests.league.policies.graphs import masked_mlp
from tests.serve_app.conftest import QUICK
from tests.serve_app.leagues import promote

BOARD = {"observation": np.zeros((6, 7, 2), int).tolist(), "action_mask": [1] * 7}


def boards(count: int, seed: int = 0) -> list[dict[str, Any]]:
    random = np.random.default_rng(seed)
    masks = random.integers(0, 2, (count, 7))
    masks[:, 3] = 1
    return [{"observation": random.integers(0, 2, (6, 7, 2)).tolist(), "action_mask": mask.tolist()} for mask in masks]


def act(client: TestClient, model: str = "board", version: Any = None, **body: Any) -> dict[str, Any]:
    reply = client.post(
        f"/v1/policies/{model}/action", json=body, params={} if version is None else {"version": version}
    )
    assert reply.status_code == 200, reply.text
    return reply.json()


def refused(client: TestClient, body: Any, status: int = 400, model: str = "board", **more: Any) -> dict[str, str]:
    """The error that a body gets, which always has a code and a sentence."""
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    reply = client.post(f"/v1/policies/{model}/action", **({"content": content} | more))
    assert reply.status_code == status, reply.text
    error = reply.json()
    assert error.keys() == {"code", "message"}
    return error


def test_one_observation_gets_the_action_of_the_champion(unchanging: TestClient, storage: Storage) -> None:
    registry = Registry.open(storage)
    policy = OnnxPolicy(masked_mlp(seed=0))
    for board in boards(20):
        expected = policy.act({name: np.array([value], np.int8) for name, value in board.items()})
        assert act(unchanging, observation=board) == {
            "action": int(expected.actions[0]),
            "model": "board",
            "version": 1,
            "sha256": registry.version("board", 1).sha256,
        }
    registry.close()


def test_a_batch_gets_the_actions_of_its_observations(unchanging: TestClient) -> None:
    batch = boards(8)
    alone = [act(unchanging, observation=board)["action"] for board in batch]
    assert act(unchanging, observations=batch)["actions"] == alone
    assert len(set(alone)) > 1


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_version_may_be_asked_for_by_number(unchanging: TestClient, version: int) -> None:
    policy = OnnxPolicy(masked_mlp(seed=version - 1))
    batch = boards(8)
    arrays = {name: np.array([board[name] for board in batch], np.int8) for name in BOARD}
    reply = act(unchanging, version=version, observations=batch)
    assert (reply["version"], reply["actions"]) == (version, policy.act(arrays).actions.tolist())


def test_an_alias_names_a_version(client: TestClient, registry: Registry) -> None:
    registry.set_alias("board", "candidate", 3, expected=None, actor="test", reason="test")
    assert act(client, version="candidate", observation=BOARD)["version"] == 3
    assert act(client, version="champion", observation=BOARD)["version"] == 1


def test_the_reply_names_the_replica(unchanging: TestClient) -> None:
    reply = unchanging.post("/v1/policies/board/action", json={"observation": BOARD})
    assert reply.headers["x-league-replica"] == "replica-1"


def test_a_league_of_several_policies_wants_one_of_them(unchanging: TestClient) -> None:
    assert act(unchanging, "duo.left", observation=BOARD)["model"] == "duo.left"
    error = refused(unchanging, {"observation": BOARD}, 404, "duo")
    assert error["code"] == "unknown_policy"
    assert "left, right" in error["message"]
    assert refused(unchanging, {"observation": BOARD}, 404, "duo.middle")["code"] == "unknown_policy"


def test_other_spaces(unchanging: TestClient) -> None:
    assert act(unchanging, "vector", observation=[0.5, -1])["action"] == [0.5, -1.0]
    nested = {"mode": 2, "sense": {"speed": [0.5, 1]}}
    assert act(unchanging, "nested", observation=nested)["action"] == 1
    nested["sense"] = {"speed": [0.5, -1]}
    assert act(unchanging, "nested", observations=[nested])["actions"] == [0]


def test_state_as_arrays_goes_in_and_comes_out(unchanging: TestClient) -> None:
    state: dict[str, Any] = {}
    actions = []
    for _ in range(4):
        reply = act(unchanging, "memory", observation=[1], state=state)
        state = reply["state"]
        actions.append(reply["action"])
    assert (actions, state) == ([0, 0, 1, 1], {"state_in_0": [[4.0]]})
    assert refused(unchanging, {"observation": [1], "state": {"state_in_0": [[1], [2]]}}, model="memory")
    assert refused(unchanging, {"observation": [1], "state": {"other": 1}}, model="memory")
    assert "state" not in act(unchanging, observation=BOARD, state={})
    error = refused(unchanging, {"observation": BOARD, "state": {"state_in_0": [[1]]}})
    assert (error["code"], "not recurrent" in error["message"]) == ("invalid_state", True)


def test_exploring_with_a_seed_is_reproducible(unchanging: TestClient) -> None:
    board = boards(1)[0]
    draws = [act(unchanging, observation=board, explore=True, seed=seed)["action"] for seed in range(60)]
    assert draws == [act(unchanging, observation=board, explore=True, seed=seed)["action"] for seed in range(60)]
    legal = {action for action, allowed in enumerate(board["action_mask"]) if allowed}
    assert set(draws) == legal
    assert draws[:8] == act(unchanging, observations=[board] * 8, explore=True, seed=list(range(8)))["actions"]


def test_exploring_without_a_seed_varies(unchanging: TestClient) -> None:
    assert len({act(unchanging, observation=BOARD, explore=True)["action"] for _ in range(60)}) > 1


def test_a_batch_with_one_seed_depends_on_the_place_alone(unchanging: TestClient) -> None:
    long = act(unchanging, observations=[BOARD] * 8, explore=True, seed=7)["actions"]
    assert act(unchanging, observations=[BOARD] * 3, explore=True, seed=7)["actions"] == long[:3]
    assert len(set(long)) > 1


def bad(**changes: Any) -> dict[str, Any]:
    """A request with a wrong board."""
    board = copy.deepcopy(BOARD) | changes
    return {"observation": {key: value for key, value in board.items() if value is not None}}


BAD_BODIES: dict[str, tuple[Any, str, str]] = {
    "empty": (b"", "malformed_body", "empty"),
    "no JSON": (b"{'observation': 1}", "malformed_body", "not JSON"),
    "cut": (b'{"observation": [1, 2', "malformed_body", "not JSON"),
    "NaN": (b'{"observation": [NaN]}', "malformed_body", "not JSON"),
    "Infinity": (b'{"observation": [Infinity]}', "malformed_body", "not JSON"),
    "bytes": (bytes(range(256)), "malformed_body", "not JSON"),
    "deep": (b'{"observation": ' + b"[" * 20_000 + b"]" * 20_000 + b"}", "malformed_body", "not JSON"),
    "deep for NumPy": (b'{"observation": ' + b"[" * 500 + b"]" * 500 + b"}", "invalid_observation", "a list"),
    "a list": ([1, 2], "malformed_body", "a list, expected an object"),
    "a string": ("board", "malformed_body", "a string, expected an object"),
    "null": (None, "malformed_body", "null, expected an object"),
    "nothing": ({}, "invalid_input", "neither observation nor observations"),
    "both": ({"observation": BOARD, "observations": [BOARD]}, "invalid_input", "both"),
    "unknown key": ({"observation": BOARD, "exlpore": True}, "invalid_input", "exlpore"),
    "explore a number": ({"observation": BOARD, "explore": 1}, "invalid_input", "explore is a number"),
    "explore a string": ({"observation": BOARD, "explore": "yes"}, "invalid_input", "explore is a string"),
    "seed a fraction": ({"observation": BOARD, "seed": 0.5}, "invalid_input", "seed must be"),
    "seed negative": ({"observation": BOARD, "seed": -1}, "invalid_input", "seed must be"),
    "seed huge": ({"observation": BOARD, "seed": 2**64}, "invalid_input", "seed must be"),
    "seed a boolean": ({"observation": BOARD, "seed": True}, "invalid_input", "seed must be"),
    "seeds for one": ({"observation": BOARD, "seed": [1]}, "invalid_input", "seed must be"),
    "too few seeds": ({"observations": [BOARD] * 2, "seed": [1]}, "invalid_input", "expected 2"),
    "no batch": ({"observations": BOARD}, "invalid_input", "observations is an object"),
    "empty batch": ({"observations": []}, "invalid_input", "empty"),
    "a wrong one in a batch": ({"observations": [BOARD, 3]}, "invalid_observation", "a number"),
    "no mask": (bad(action_mask=None), "invalid_observation", "observation has no action_mask"),
    "bare list": ({"observation": BOARD["observation"]}, "invalid_observation", "observation, action_mask"),
    "null observation": ({"observation": None}, "invalid_observation", "observation is null"),
    "unknown key inside": (bad(reward=1), "invalid_observation", "'reward'"),
    "wrong shape": (bad(observation=[[0, 1]]), "invalid_observation", "expected [6, 7, 2]"),
    "a number for a board": (bad(observation=3), "invalid_observation", "expected [6, 7, 2]"),
    "ragged": (bad(observation=[[0], [0, 1]]), "invalid_observation", "ragged"),
    "an object inside": (bad(observation=[{"a": 1}]), "invalid_observation", "other than numbers"),
    "null inside": (bad(observation=[[[None, 0]] * 7] * 6), "invalid_observation", "other than numbers"),
    "numbers as strings": (bad(observation=[[["0", "1"]] * 7] * 6), "invalid_observation", "stands where a number"),
    "fractions for integers": (bad(observation=[[[0.5, 0]] * 7] * 6), "invalid_observation", "int8"),
    "too large for the dtype": (bad(observation=[[[300, 0]] * 7] * 6), "invalid_observation", "127"),
    "too large for any dtype": (bad(observation=[[[10**30, 0]] * 7] * 6), "invalid_observation", "127"),
    "nothing legal": (bad(action_mask=[0] * 7), "illegal_mask", "at least one"),
    "mask of twos": (bad(action_mask=[2] + [1] * 6), "illegal_mask", "0 and 1"),
    "negative mask": (bad(action_mask=[-1] + [1] * 6), "illegal_mask", "0 and 1"),
    "short mask": (bad(action_mask=[1] * 6), "invalid_observation", "expected [7]"),
    "flat batch of masks": (bad(action_mask=[[1] * 7]), "invalid_observation", "expected [7]"),
}


@pytest.mark.parametrize("name", BAD_BODIES)
def test_a_bad_body_is_refused_in_a_sentence(unchanging: TestClient, name: str) -> None:
    body, code, words = BAD_BODIES[name]
    error = refused(unchanging, body)
    assert error["code"] == code
    assert words in error["message"]


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b'{"observation": [1e999, 0]}', "finite"),
        ({"observation": [1, 2, 3]}, "expected [2]"),
        ({"observation": {"observation": [1, 2], "action_mask": [1]}}, "other than numbers"),
    ],
)
def test_a_bad_vector_is_refused(unchanging: TestClient, body: Any, words: str) -> None:
    error = refused(unchanging, body, model="vector")
    assert error["code"] in ("invalid_observation", "malformed_body")
    assert words in error["message"] or "JSON" in error["message"]


def test_a_discrete_observation_stays_in_its_range(unchanging: TestClient) -> None:
    error = refused(unchanging, {"observation": {"mode": 4, "sense": {"speed": [1, 1]}}}, model="nested")
    assert "observation.mode must be between 1 and 3" in error["message"]
    error = refused(unchanging, {"observation": {"mode": 1, "sense": [1, 1]}}, model="nested")
    assert "observation.sense is a list" in error["message"]


def test_a_continuous_policy_explores_reproducibly(unchanging: TestClient) -> None:
    def explored(seed: int) -> list[float]:
        body = {"observation": [0, 0], "explore": True, "seed": seed}
        return unchanging.post("/v1/policies/vector/action", json=body).json()["action"]

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
def test_what_does_not_exist(unchanging: TestClient, path: str, status: int, code: str) -> None:
    reply = unchanging.post(path, json={"observation": BOARD})
    assert (reply.status_code, reply.json()["code"]) == (status, code)


@pytest.mark.parametrize("league", ["empty", "headless"])
def test_a_league_without_a_champion_is_not_ready(unchanging: TestClient, league: str) -> None:
    reply = unchanging.post(f"/v1/policies/{league}/action", json={"observation": BOARD})
    assert (reply.status_code, reply.json()["code"]) == (503, "not_ready")
    assert int(reply.headers["retry-after"]) >= 1


def test_a_version_of_a_league_without_a_champion_answers(unchanging: TestClient) -> None:
    assert act(unchanging, "headless", version=1, observation=BOARD)["version"] == 1


@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE", "PATCH", "HEAD", "OPTIONS"])
def test_another_method_is_refused(unchanging: TestClient, method: str) -> None:
    reply = unchanging.request(method, "/v1/policies/board/action")
    assert (reply.status_code, reply.headers["allow"]) == (405, "POST")
    assert method == "HEAD" or reply.json()["code"] == "method_not_allowed"


@pytest.mark.parametrize("media_type", ["image/png", "multipart/form-data; boundary=x", "text/html", "nonsense"])
def test_a_body_that_is_said_to_be_something_else(unchanging: TestClient, media_type: str) -> None:
    error = refused(unchanging, {"observation": BOARD}, 415, headers={"content-type": media_type})
    assert error["code"] == "unsupported_media_type"


@pytest.mark.parametrize("media_type", ["application/json; charset=utf-8", "application/x-www-form-urlencoded"])
def test_what_clients_call_json(unchanging: TestClient, media_type: str) -> None:
    reply = unchanging.post(
        "/v1/policies/board/action",
        content=json.dumps({"observation": BOARD}),
        headers={"content-type": media_type},
    )
    assert reply.status_code == 200


def test_a_large_body_is_refused(unchanging: TestClient) -> None:
    error = refused(unchanging, b" " * (64 * 1024 + 1), 413)
    assert error["code"] == "body_too_large"
    in_parts = (b" " * 1024 for _ in range(65))  # without a length
    assert refused(unchanging, None, 413, content=in_parts)["code"] == "body_too_large"


def test_a_large_batch_is_refused(unchanging: TestClient) -> None:
    error = refused(unchanging, {"observations": [BOARD] * 9}, 413)
    assert error == {"code": "body_too_large", "message": "observations holds 9, expected at most 8"}


@pytest.mark.anyio
async def test_too_many_requests_at_once_are_told_to_come_back(registry: Registry) -> None:
    server = Server(registry, QUICK.model_copy(update={"max_in_flight": 2}), "replica-1")
    body_comes = asyncio.Event()

    async def body() -> AsyncIterator[bytes]:
        await body_comes.wait()
        yield json.dumps({"observation": BOARD}).encode()

    transport = httpx.ASGITransport(server.application())
    async with server.watcher.watching(), httpx.AsyncClient(transport=transport, base_url="http://replica") as client:
        slow = [asyncio.create_task(client.post("/v1/policies/board/action", content=body())) for _ in range(2)]
        while server.action.in_flight < 2:
            await asyncio.sleep(0)
        reply = await client.post("/v1/policies/board/action", json={"observation": BOARD})
        assert (reply.status_code, reply.json()["code"]) == (429, "overloaded")
        assert reply.headers["retry-after"] == "1"
        body_comes.set()
        assert [(await each).status_code for each in slow] == [200, 200]
        assert (await client.post("/v1/policies/board/action", json={"observation": BOARD})).status_code == 200


def test_strings_do_not_cost_memory(unchanging: TestClient) -> None:
    """NumPy would make 20,000 strings of 20,000 characters each of this: 1.6 GB."""
    refused(unchanging, {"observation": ["x" * 20_000] + [""] * 10_000}, model="vector")


def test_a_promotion_is_followed(client: TestClient, registry: Registry) -> None:
    for version in (2, 3, 1):
        promote(registry, "board", version)
        while act(client, observation=BOARD)["version"] != version:
            pass


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


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    body=st.binary(max_size=60) | near_misses.map(lambda body: json.dumps(body).encode()),
    model=st.sampled_from(["board", "vector", "nested", "memory", "duo", "duo.left"]) | st.text(max_size=10),
    version=st.sampled_from(["", "1", "champion"]) | st.text(max_size=10),
)
def test_no_input_is_the_server_s_fault(unchanging: TestClient, body: bytes, model: str, version: str) -> None:
    url = f"/v1/policies/{quote(model, safe='')}/action?version={quote(version, safe='')}"
    reply = unchanging.post(url, content=body)
    assert reply.status_code < 500 or (reply.status_code, reply.json()["code"]) == (503, "not_ready")
    if reply.status_code == 200:
        assert "code" not in reply.json()
    else:
        assert reply.json().keys() == {"code", "message"}
