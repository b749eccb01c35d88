"""Messages of a stream: their answers, the state between them, and the version that answers."""

import json
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse, WebSocketTestSession
from starlette.websockets import WebSocketDisconnect

from league.errors import LeagueError, Overloaded
from league.policies.onnx import OnnxPolicy
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from league.settings import Storage
from serve_app.access import api_keys
from serve_app.access.api_keys import TokenBucket
from serve_app.app import Replica
from serve_app.inference.stream_codec import HAS_RESETS, REQUEST, RESPONSE, encode_request
from tests.support.clients.actions import BAD_BODIES, BOARD, act, boards
from tests.support.leagues.served_leagues import promote, publish
from tests.support.policies.graphs import counting, masked_mlp
from tests.support.servers.exposition import value
from tests.support.servers.replicas import QUICK, local_client, replica
from tests.support.servers.shadows import set_shadow, wait_for
from tests.support.waiting import until

ONE = {"observation": [1]}
BODY = {"observation": BOARD}


def open_stream(client: TestClient, model: str = "board", query: str = "", **headers: str) -> WebSocketTestSession:
    named = {name.replace("_", "-"): text for name, text in headers.items()}
    return client.websocket_connect(f"/v1/policies/{model}/stream{query}", headers=named)


def answer_to(stream: WebSocketTestSession, **message: Any) -> dict[str, Any]:
    """The answer to a message, which must not be an error."""
    answer = send(stream, message)
    assert "code" not in answer, answer
    return answer


def send(stream: WebSocketTestSession, message: Any) -> dict[str, Any]:
    stream.send_text(message if isinstance(message, str) else json.dumps(message))
    return stream.receive_json()


def binary(stream: WebSocketTestSession, message: bytes) -> tuple[np.ndarray, int]:
    """The actions that answer a binary message, as int64, and their version."""
    stream.send_bytes(message)
    reply = stream.receive()
    assert reply.get("bytes") is not None, reply
    framing, flags, zero, rows, version, last = RESPONSE.unpack_from(reply["bytes"])
    assert (framing, flags, zero, last) == (1, 0, 0, 0)
    actions = np.frombuffer(reply["bytes"], "<i8", offset=RESPONSE.size)
    assert len(actions) == rows
    return actions, version


def arrays(batch: list[dict[str, Any]]) -> list[np.ndarray]:
    return [np.array([board[name] for board in batch], np.int8) for name in ("observation", "action_mask")]


def counter_message(rows: int, reset: bool = False, amount: float = 1) -> bytes:
    return encode_request([np.full((rows, 1), amount, "<f4")], rows, reset=reset)


@pytest.fixture
def second(registry: Registry) -> int:
    """A second version of the recurrent policy, not promoted."""
    return publish(registry, "memory", {"shared": counting()}, "run/2").number


def test_a_stream_answers_like_the_action_route(read_only_client: TestClient) -> None:
    batch = boards(8)
    expected = [act(read_only_client, observation=board) for board in batch]
    with open_stream(read_only_client) as stream:
        assert [answer_to(stream, observation=board) for board in batch] == expected
        assert answer_to(stream, observations=batch) == act(read_only_client, observations=batch)
        request = {"observation": batch[0], "explore": True, "seed": 7, "probabilities": True}
        assert answer_to(stream, **request) == act(read_only_client, **request)
        head = dict(stream.extra_headers)
    assert head[b"x-league-replica"] == b"replica-1"
    assert (head[b"x-league-version"], head[b"x-league-sha256"].decode()) == (b"1", expected[0]["sha256"])


def test_binary_messages_are_answered_like_json(read_only_client: TestClient) -> None:
    batch = boards(8)
    with open_stream(read_only_client) as stream:
        best = act(read_only_client, observations=batch)["actions"]
        actions, version = binary(stream, encode_request(arrays(batch), 8))
        assert (actions.tolist(), version) == (best, 1)
        for seed in (3, [5] * 8):
            drawn = act(read_only_client, observations=batch, explore=True, seed=seed)["actions"]
            one = seed if isinstance(seed, int) else None
            answered = [
                binary(stream, encode_request(arrays([board]), 1, 5, explore=True))[0][0]
                for board in batch
                if one is None
            ] or binary(stream, encode_request(arrays(batch), 8, one, explore=True))[0].tolist()
            assert answered == drawn
        assert answer_to(stream, observation=batch[0])["action"] == best[0], "both formats can be mixed"


def test_vectors_are_answered_in_their_dtype(read_only_client: TestClient) -> None:
    with open_stream(read_only_client, "vector") as stream:
        observation = np.array([[0.5, -1], [0.25, 1]], "<f4")
        stream.send_bytes(encode_request([observation], 2))
        reply = stream.receive_bytes()
        assert reply == RESPONSE.pack(1, 0, 0, 2, 1, 0) + observation.tobytes()
        assert answer_to(stream, observation=[0.5, -1], probabilities=True).keys() > {"probabilities"}


def test_recurrent_state_is_kept_by_the_stream(read_only_client: TestClient) -> None:
    with open_stream(read_only_client, "memory") as stream:
        assert [answer_to(stream, **ONE)["action"] for _ in range(4)] == [0, 0, 1, 1]
        assert "state" not in answer_to(stream, **ONE)
        assert answer_to(stream, **ONE, reset=True)["action"] == 0
        assert [answer_to(stream, **ONE)["action"] for _ in range(2)] == [0, 1]
        assert [binary(stream, counter_message(1))[0][0], binary(stream, counter_message(1, reset=True))[0][0]] == [
            1,
            0,
        ]
        assert answer_to(stream, **ONE, state=None)["action"] == 0, "null also starts an episode"
        signature = answer_to(stream, reset=True)
        assert signature == {"reset": True} | {name: signature[name] for name in ("model", "version", "sha256")}
        assert [answer_to(stream, **ONE)["action"] for _ in range(3)] == [0, 0, 1]
    with open_stream(read_only_client, "memory") as stream:
        assert answer_to(stream, observation=[3])["action"] == 1, "the state was reset"


def test_each_row_of_a_batch_has_its_own_state(read_only_client: TestClient) -> None:
    rows = [[1], [2], [0]]
    with open_stream(read_only_client, "memory") as stream:
        assert answer_to(stream, observations=rows)["actions"] == [0, 0, 0]
        assert answer_to(stream, observations=rows)["actions"] == [0, 1, 0]
        assert answer_to(stream, observations=rows, reset=[False, True, False])["actions"] == [1, 0, 0]
        resets = REQUEST.pack(1, HAS_RESETS, 0, 3, 0) + b"\1\0\0" + np.array(rows, "<f4").tobytes()
        assert binary(stream, resets)[0].tolist() == [0, 1, 0]
        assert binary(stream, counter_message(3, amount=0))[0].tolist() == [0, 1, 0]
        assert answer_to(stream, observations=rows, reset=[True] * 3)["actions"] == [0, 0, 0]
        error = send(stream, {"observations": rows[:2]})
        assert (error["code"], "a reset is required" in error["message"]) == ("invalid_state", True)
        assert answer_to(stream, observations=rows)["actions"] == [0, 1, 0], (
            "a rejected message does not change the state"
        )
        assert answer_to(stream, observations=rows[:2], reset=True)["actions"] == [0, 0]
        assert answer_to(stream, observation=[3], reset=True)["action"] == 1


def test_a_rejected_message_with_resets_does_not_reset(read_only_client: TestClient) -> None:
    rows = [[1], [2], [0]]
    with open_stream(read_only_client, "memory") as stream:
        assert answer_to(stream, observations=rows)["actions"] == [0, 0, 0]
        error = send(stream, {"observations": [[1], ["x"], [0]], "reset": [True, True, False]})
        assert error["code"] == "invalid_observation"
        assert answer_to(stream, observations=rows)["actions"] == [0, 1, 0]


def test_state_can_be_returned_and_set_as_a_token(read_only_client: TestClient) -> None:
    with open_stream(read_only_client, "memory") as stream:
        tokens = [answer_to(stream, **ONE, return_state=True)["state"] for _ in range(2)]
        assert tokens[0] == act(read_only_client, "memory", **ONE)["state"]
        batch = answer_to(stream, observations=[[1], [2]], state=[tokens[1], None], return_state=True)
        assert (batch["actions"], len(batch["state"])) == ([1, 0], 2)
        assert answer_to(stream, observations=[[0], [1]])["actions"] == [1, 1], (
            "the stream continues with the state of the token"
        )
    with open_stream(read_only_client, "memory") as other:
        assert answer_to(other, **ONE, state=tokens[1])["action"] == 1
        assert act(read_only_client, "memory", **ONE, state=tokens[1])["action"] == 1


def test_a_stream_is_pinned_to_its_version(client: TestClient, registry: Registry) -> None:
    registry.aliases.set("board", "candidate", 3, expected=None, actor="test", reason="test")
    with ExitStack() as stack:
        queries = ("", "?version=2", "?version=candidate")
        streams = [stack.enter_context(open_stream(client, query=query)) for query in queries]
        promote(registry, "board", 2)
        registry.aliases.set("board", "candidate", 1, expected=3, actor="test", reason="test")
        until(lambda: [act(client, version=alias, **BODY)["version"] for alias in ("champion", "candidate")] == [2, 1])
        assert [answer_to(stream, **BODY)["version"] for stream in streams] == [1, 2, 3]
        assert [binary(stream, encode_request(arrays([BOARD]), 1))[1] for stream in streams] == [1, 2, 3]


def test_a_following_stream_answers_with_the_current_version(client: TestClient, registry: Registry) -> None:
    expected = {version: masked_mlp(seed=version - 1) for version in (1, 2, 3)}
    (board,) = boards(1)
    batch = dict(zip(("observation", "action_mask"), arrays([board]), strict=True))
    with open_stream(client, query="?follow=champion") as stream:
        for version in (2, 3, 1):
            promote(registry, "board", version)
            until(lambda version=version: answer_to(stream, observation=board)["version"] == version)
            actions, answered = binary(stream, encode_request(arrays([board]), 1))
            assert (answered, actions.tolist()) == (version, OnnxPolicy(expected[version]).act(batch).actions.tolist())


def test_a_following_stream_reports_that_its_alias_was_removed(client: TestClient, registry: Registry) -> None:
    registry.aliases.set("board", "beta", 3, expected=ANY, actor="test", reason="test")
    with open_stream(client, query="?follow=beta") as stream, open_stream(client, query="?follow=champion") as other:
        assert answer_to(stream, **BODY)["version"] == 3
        until(lambda: "beta" in client.get("/v1/leagues/board").json()["replicas"][0]["aliases"])
        registry.removal.remove_version(CheckpointRef("board", 3), force=True)
        until(lambda: send(stream, BODY).get("code") == "unknown_alias")
        assert answer_to(other, **BODY)["version"] == 1
        registry.removal.remove_version(CheckpointRef("board", 1), force=True)
        until(lambda: (error := send(other, BODY)).get("code") == "not_ready" and error["status"] == 503)
        promote(registry, "board", 2)
        until(lambda: send(other, BODY).get("version") == 2)


def test_an_episode_keeps_its_version_in_a_following_stream(
    client: TestClient, registry: Registry, second: int
) -> None:
    with open_stream(client, "memory", "?follow=champion") as stream:
        token = answer_to(stream, **ONE, return_state=True)["state"]
        promote(registry, "memory", second)
        until(lambda: act(client, "memory", **ONE)["version"] == second)
        assert [answer_to(stream, **ONE)["version"] for _ in range(2)] == [1, 1]
        assert answer_to(stream, observations=[[1]], state=[token])["version"] == 1
        assert answer_to(stream, **ONE, reset=True)["version"] == second
        assert answer_to(stream, **ONE, state=token)["version"] == 1, "the token selects the version of its episode"
        assert answer_to(stream, **ONE)["version"] == 1
        assert answer_to(stream, reset=True)["version"] == second


def test_a_token_of_another_version_is_rejected_by_a_pinned_stream(client: TestClient, second: int) -> None:
    token = act(client, "memory", version=second, **ONE)["state"]
    with open_stream(client, "memory") as stream:
        answer_to(stream, observation=[2])
        error = send(stream, ONE | {"state": token})
        assert (error["code"], error["status"]) == ("invalid_state", 400)
        assert f"version {second}" in error["message"]
        assert answer_to(stream, **ONE)["action"] == 1, "the episode of the stream continues"


def test_a_canary_applies_to_following_streams_by_key(client: TestClient, registry: Registry) -> None:
    setting = registry.traffic.set("board", canary=Portion(2, 1.0), actor="test", reason="test")
    until(lambda: [one.traffic for one in registry.replicas.acknowledgements("board")] == [setting.id])
    with (
        open_stream(client, query="?follow=champion", x_league_key="player") as with_key,
        open_stream(client, query="?follow=champion") as without,
        open_stream(client, query="?version=1", x_league_key="player") as pinned,
    ):
        assert [answer_to(stream, **BODY)["version"] for stream in (with_key, without, pinned)] == [2, 1, 1]
        registry.traffic.set("board", canary=None, actor="test", reason="test")
        until(lambda: answer_to(with_key, **BODY)["version"] == 1)


@pytest.mark.parametrize("name", sorted(BAD_BODIES.keys() - {"bytes"}))
def test_a_rejected_message_does_not_end_the_stream(read_only_client: TestClient, name: str) -> None:
    body, code, message = BAD_BODIES[name]
    text = body if isinstance(body, bytes) else json.dumps(body).encode()
    with open_stream(read_only_client) as stream:
        error = send(stream, text.decode())
        assert error.keys() == {"code", "message", "status"}
        assert (error["code"], error["status"]) == (code, 400)
        assert message in error["message"]
        assert answer_to(stream, **BODY)["version"] == 1


@pytest.mark.parametrize(
    ("message", "code", "expected"),
    [
        (ONE | {"reset": 1}, "invalid_input", "reset is a number, expected true or false"),
        (ONE | {"reset": [True]}, "invalid_input", "reset is a list"),
        ({"observations": [[1]], "reset": [True, True]}, "invalid_input", "must have 1"),
        ({"observations": [[1]], "reset": [1]}, "invalid_input", "must have 1"),
        (ONE | {"return_state": "yes"}, "invalid_input", "return_state"),
        ({"reset": False}, "invalid_input", "neither observation nor observations"),
        ({"reset": True, "explore": True}, "invalid_input", "neither observation nor observations"),
        (ONE | {"state": {}}, "invalid_state", "streams do not accept arrays"),
        (ONE | {"state": "AQEA"}, "invalid_state", "not a complete token"),
        (ONE | {"forget": True}, "invalid_input", "'forget'"),
        ({"observation": ["1"]}, "invalid_observation", "where a number"),
        ({"observations": [[1]] * 9}, "body_too_large", "at most 8"),
    ],
)
def test_invalid_stream_options_are_rejected(
    read_only_client: TestClient, message: Any, code: str, expected: str
) -> None:
    with open_stream(read_only_client, "memory") as stream:
        answer_to(stream, observation=[2])
        error = send(stream, message)
        assert error["code"] == code
        assert expected in error["message"]
        assert answer_to(stream, **ONE)["action"] == 1, "the state is unchanged"


def test_reset_and_state_contradict_each_other(read_only_client: TestClient) -> None:
    with open_stream(read_only_client, "memory") as stream:
        token = answer_to(stream, **ONE, return_state=True)["state"]
        assert send(stream, ONE | {"reset": True, "state": token})["code"] == "invalid_state"
    with open_stream(read_only_client) as stream:
        error = send(stream, BODY | {"state": token})
        assert (error["code"], "expected board" in error["message"]) == ("invalid_state", True)


HEAD = REQUEST.pack(1, 0, 0, 1, 0)


@pytest.mark.parametrize(
    ("message", "code", "expected"),
    [
        (b"", "invalid_input", "0 bytes, expected a header of 16"),
        (HEAD[:15], "invalid_input", "15 bytes"),
        (b"\2" + HEAD[1:], "invalid_input", "02 00 00 00"),
        (REQUEST.pack(1, 32, 0, 1, 0), "invalid_input", "01 20"),
        (REQUEST.pack(1, 17, 0, 1, 0), "invalid_input", "not both"),
        (REQUEST.pack(1, 0, 1, 1, 0), "invalid_input", "expected 01"),
        (REQUEST.pack(1, 0, 0, 0, 0), "invalid_input", "0 rows"),
        (REQUEST.pack(1, 0, 0, 9, 0), "body_too_large", "1 to 8"),
        (REQUEST.pack(1, 2, 0, 1, 2**63), "invalid_input", "seed"),
        (REQUEST.pack(1, 0, 0, 1, 7), "invalid_input", "seed"),
        (REQUEST.pack(1, 8, 0, 2, 0) + b"\0", "invalid_input", "2 bytes of 0 or 1"),
        (REQUEST.pack(1, 8, 0, 2, 0) + b"\0\2", "invalid_input", "2 bytes of 0 or 1"),
        (HEAD, "invalid_observation", "0 bytes, expected 91: 1 rows of 84 observation + 7 action_mask"),
        (HEAD + bytes(90), "invalid_observation", "90 bytes"),
        (HEAD + bytes(91), "illegal_mask", "at least one"),
    ],
)
def test_an_invalid_binary_message_is_rejected(
    read_only_client: TestClient, message: bytes, code: str, expected: str
) -> None:
    with open_stream(read_only_client) as stream:
        stream.send_bytes(message)
        error = stream.receive_json()
        assert error["code"] == code
        assert expected in error["message"]
        assert answer_to(stream, **BODY)["version"] == 1


@pytest.mark.parametrize(
    ("model", "tensors", "expected"),
    [
        ("vector", [np.array([np.nan, 0], "<f4")], "finite"),
        ("nested", [np.array([4], "<i8"), np.zeros(2, "<f4")], "observation.mode must be between 1 and 3"),
    ],
)
def test_values_are_checked_like_on_the_action_route(
    read_only_client: TestClient, model: str, tensors: list[np.ndarray], expected: str
) -> None:
    with open_stream(read_only_client, model) as stream:
        stream.send_bytes(encode_request(tensors, 1))
        error = stream.receive_json()
        assert error["code"] == "invalid_observation"
        assert expected in error["message"]


@pytest.mark.parametrize(
    ("model", "query", "status", "code"),
    [
        ("nobody", "", 404, "unknown_league"),
        ("board", "?version=99", 404, "unknown_version"),
        ("board", "?follow=rival", 404, "unknown_alias"),
        ("board", "?follow=7", 400, "invalid_reference"),
        ("board", "?version=best&follow=champion", 400, "invalid_input"),
        ("board.other", "", 404, "unknown_policy"),
        ("duo", "", 404, "unknown_policy"),
        ("headless", "", 503, "not_ready"),
    ],
)
def test_a_stream_that_cannot_be_opened_is_rejected(
    read_only_client: TestClient, model: str, query: str, status: int, code: str
) -> None:
    with pytest.raises(WebSocketDenialResponse) as caught, open_stream(read_only_client, model, query):
        pass
    assert (caught.value.status_code, caught.value.json()["code"]) == (status, code)
    assert ("retry-after" in caught.value.headers) == (status == 503)


def test_a_removed_version_is_reported(client: TestClient, registry: Registry) -> None:
    shutil.rmtree(registry.artifacts.path("board", 2))
    with pytest.raises(WebSocketDenialResponse) as caught, open_stream(client, query="?version=2"):
        pass
    assert (caught.value.status_code, caught.value.json()["code"]) == (410, "version_retired")


def test_the_number_of_streams_is_limited(storage: Storage) -> None:
    with replica(storage, QUICK.model_copy(update={"max_streams": 1})) as client:
        for _ in range(2):
            with open_stream(client) as stream:
                answer_to(stream, **BODY)
                with pytest.raises(WebSocketDenialResponse) as caught, open_stream(client):
                    pass
                assert (caught.value.status_code, caught.value.json()["code"]) == (429, "overloaded")


def close_of(stream: WebSocketTestSession, message: Any) -> WebSocketDisconnect:
    """Repeat a message until the stream is closed; returns the close."""
    with pytest.raises(WebSocketDisconnect) as caught:
        until(lambda: answer_to(stream, **message) and False)
    return caught.value


def test_revoking_a_key_ends_its_streams(client: TestClient, registry: Registry) -> None:
    _, token = registry.keys.create("bot", ["act"])
    with open_stream(client) as open_before:
        until(lambda: client.post("/v1/policies/board/action", json=BODY).status_code == 401)
        close = close_of(open_before, BODY)
        assert (close.code, close.reason) == (1008, "this stream now requires an API key")
    with open_stream(client, x_api_key=token) as stream:
        answer_to(stream, **BODY)
        registry.keys.revoke("bot")
        close = close_of(stream, BODY)
        assert (close.code, "bot was revoked" in close.reason) == (1008, True)


def test_the_first_key_ends_an_idle_stream_without_one(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("serve_app.routes.stream.KEY_CHECK_INTERVAL", 0.1)
    with replica(registry.storage) as client, open_stream(client) as stream:
        registry.keys.create("bot", ["act"])
        with pytest.raises(WebSocketDisconnect) as caught:
            stream.receive_json()
        assert (caught.value.code, caught.value.reason) == (1008, "this stream now requires an API key")


def test_each_message_counts_for_the_rate_limit_of_a_key(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_keys, "TokenBucket", partial(TokenBucket, clock=lambda: 0.0))  # no time passes
    _, token = registry.keys.create("slow", ["act"], rate=0.5)
    with replica(registry.storage) as client, open_stream(client, authorization=f"Bearer {token}") as stream:
        error = send(stream, BODY)
        assert (error["code"], error["status"], error["retry_after"]) == ("rate_limited", 429, 2)


def test_a_message_that_is_too_large_ends_the_stream(read_only_client: TestClient) -> None:
    with open_stream(read_only_client) as stream:
        stream.send_text(" " * (64 * 1024 + 1))
        with pytest.raises(WebSocketDisconnect) as caught:
            stream.receive_text()
        assert caught.value.code == 1009


@pytest.fixture
def server(registry: Registry) -> Replica:
    return Replica(Registry.open(registry.storage), QUICK, "replica-1")


@pytest.fixture
def patchable_client(server: Replica) -> Iterator[TestClient]:
    """The application of `server`, which a test may patch."""
    with local_client(server) as client:
        yield client


def test_a_persistent_queue_is_shed(
    server: Replica, patchable_client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Any) -> None:
        raise Overloaded("more than 64 requests wait here already")

    with open_stream(patchable_client) as stream:
        monkeypatch.setattr(type(server.access.backlog), "admit", full)
        error = send(stream, BODY)
        assert (error["code"], error["status"], error["retry_after"]) == ("overloaded", 429, 1)
        monkeypatch.undo()
        answer_to(stream, **BODY)


@pytest.mark.parametrize(
    ("fault", "code", "status"), [(MemoryError("no room"), "internal_error", 500), (LeagueError("so"), "error", 500)]
)
def test_an_internal_error_does_not_end_the_stream(
    patchable_client: TestClient,
    monkeypatch: pytest.MonkeyPatch,
    fault: Exception,
    code: str,
    status: int,
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise fault

    with open_stream(patchable_client) as stream:
        # Not of one policy: a replica that is slow for a moment runs another.
        monkeypatch.setattr(OnnxPolicy, "act", fail)
        error = send(stream, BODY)
        assert (error["status"], "no room" in error["message"]) == (status, False)
        monkeypatch.undo()
        answer_to(stream, **BODY)
    until(lambda: value(patchable_client, "league_errors_total", league="board", code=error["code"]) == 1)


def test_messages_are_counted(client: TestClient) -> None:
    with open_stream(client) as stream:
        until(lambda: value(client, "league_requests_in_flight", api="stream") == 1)
        for _ in range(3):
            answer_to(stream, **BODY)
        binary(stream, encode_request(arrays(boards(5)), 5))
        send(stream, {})
        send(stream, {})
    until(lambda: value(client, "league_request_seconds_count", api="stream") == 4)
    assert value(client, "league_request_seconds_count", policy="shared", version="1") == 4
    assert value(client, "league_batch_observations_sum", api="stream") == 8
    until(lambda: value(client, "league_errors_total", league="board", code="invalid_input") == 2)
    until(lambda: value(client, "league_requests_in_flight", api="stream") == 0)


def test_messages_are_mirrored_to_the_shadow(client: TestClient, registry: Registry) -> None:
    set_shadow(registry)
    observations = boards(12)
    with open_stream(client) as stream, open_stream(client, query="?version=3") as pinned:
        for board in observations[:4]:
            answer_to(stream, observation=board)
            answer_to(pinned, observation=board)
        binary(stream, encode_request(arrays(observations[4:]), 8))
    found = wait_for(registry, lambda one: one.requests == 5)
    batch = dict(zip(("observation", "action_mask"), arrays(observations), strict=True))
    first, second = (OnnxPolicy(masked_mlp(seed=seed)).act(batch).actions for seed in (0, 1))
    assert (found.champion, found.observations) == (1, 12)
    assert found.agreed == int((first == second).sum())


def test_a_continued_episode_is_not_mirrored(client: TestClient, registry: Registry, second: int) -> None:
    set_shadow(registry, second, league="memory")
    with open_stream(client, "memory") as stream:
        for _ in range(3):
            answer_to(stream, **ONE)
        answer_to(stream, **ONE, reset=True)
    found = wait_for(registry, lambda one: one.requests + one.skipped == 4, league="memory")
    assert (found.requests, found.skipped) == (2, 2)


def test_a_slow_graph_does_not_block_other_requests(registry: Registry) -> None:
    """Rows beyond the inline limit run in a thread, and are answered on the same stream."""
    settings = QUICK.model_copy(update={"inline": 1e-9})
    with replica(registry.storage, settings) as client, open_stream(client, "memory") as stream:
        assert [answer_to(stream, **ONE)["action"] for _ in range(4)] == [0, 0, 1, 1]
        assert binary(stream, counter_message(1))[0].tolist() == [1]
