"""A stream's conversation: what a message is answered, what is kept between two, and who answers."""

import json
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse, WebSocketTestSession
from starlette.websockets import WebSocketDisconnect

from league.errors import LeagueError, Overloaded
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.registry.rows import Portion
from league.settings import Storage
from serve_app.app import Server
from serve_app.stream_framing import HAS_RESETS, REPLY, REQUEST, request
from tests.league.policies.graphs import counting, masked_mlp
from tests.serve_app.conftest import QUICK, replica
from tests.serve_app.leagues import promote, publish
from tests.serve_app.test_action import BAD_BODIES, BOARD, act, boards
from tests.serve_app.test_alias_watcher import until
from tests.serve_app.test_metrics import value
from tests.serve_app.test_shadow import mirror, wait_for

ONE = {"observation": [1]}
BODY = {"observation": BOARD}


def opened(client: TestClient, model: str = "board", query: str = "", **headers: str) -> WebSocketTestSession:
    named = {name.replace("_", "-"): text for name, text in headers.items()}
    return client.websocket_connect(f"/v1/policies/{model}/stream{query}", headers=named)


def said(stream: WebSocketTestSession, **message: Any) -> dict[str, Any]:
    """The answer to a message, which is no error."""
    answer = told(stream, message)
    assert "code" not in answer, answer
    return answer


def told(stream: WebSocketTestSession, message: Any) -> dict[str, Any]:
    stream.send_text(message if isinstance(message, str) else json.dumps(message))
    return stream.receive_json()


def binary(stream: WebSocketTestSession, message: bytes) -> tuple[np.ndarray, int]:
    """The actions that answer a binary message, as int64, and their version."""
    stream.send_bytes(message)
    reply = stream.receive()
    assert reply.get("bytes") is not None, reply
    framing, flags, zero, rows, version, last = REPLY.unpack_from(reply["bytes"])
    assert (framing, flags, zero, last) == (1, 0, 0, 0)
    actions = np.frombuffer(reply["bytes"], "<i8", offset=REPLY.size)
    assert len(actions) == rows
    return actions, version


def arrays(batch: list[dict[str, Any]]) -> list[np.ndarray]:
    return [np.array([board[name] for board in batch], np.int8) for name in ("observation", "action_mask")]


def counted(rows: int, reset: bool = False, amount: float = 1) -> bytes:
    return request([np.full((rows, 1), amount, "<f4")], rows, reset=reset)


@pytest.fixture
def second(registry: Registry) -> int:
    """A second version of the recurrent policy, which is not promoted."""
    return publish(registry, "memory", {"shared": counting()}, "run/2").number


def test_a_stream_answers_as_the_action_route_does(unchanging: TestClient) -> None:
    batch = boards(8)
    expected = [act(unchanging, observation=board) for board in batch]
    with opened(unchanging) as stream:
        assert [said(stream, observation=board) for board in batch] == expected
        assert said(stream, observations=batch) == act(unchanging, observations=batch)
        asked = {"observation": batch[0], "explore": True, "seed": 7, "probabilities": True}
        assert said(stream, **asked) == act(unchanging, **asked)
        head = dict(stream.extra_headers)
    assert head[b"x-league-replica"] == b"replica-1"
    assert (head[b"x-league-version"], head[b"x-league-sha256"].decode()) == (b"1", expected[0]["sha256"])


def test_binary_messages_are_answered_as_those_in_json(unchanging: TestClient) -> None:
    batch = boards(8)
    with opened(unchanging) as stream:
        best = act(unchanging, observations=batch)["actions"]
        actions, version = binary(stream, request(arrays(batch), 8))
        assert (actions.tolist(), version) == (best, 1)
        for seed in (3, [5] * 8):
            drawn = act(unchanging, observations=batch, explore=True, seed=seed)["actions"]
            one = seed if isinstance(seed, int) else None
            answered = [
                binary(stream, request(arrays([board]), 1, 5, explore=True))[0][0] for board in batch if one is None
            ] or binary(stream, request(arrays(batch), 8, one, explore=True))[0].tolist()
            assert answered == drawn
        assert said(stream, observation=batch[0])["action"] == best[0], "both kinds may be mixed"


def test_vectors_are_answered_in_their_own_dtype(unchanging: TestClient) -> None:
    with opened(unchanging, "vector") as stream:
        observation = np.array([[0.5, -1], [0.25, 1]], "<f4")
        stream.send_bytes(request([observation], 2))
        reply = stream.receive_bytes()
        assert reply == REPLY.pack(1, 0, 0, 2, 1, 0) + observation.tobytes()
        assert said(stream, observation=[0.5, -1], probabilities=True).keys() > {"probabilities"}


def test_recurrent_state_stays_with_the_stream(unchanging: TestClient) -> None:
    with opened(unchanging, "memory") as stream:
        assert [said(stream, **ONE)["action"] for _ in range(4)] == [0, 0, 1, 1]
        assert "state" not in said(stream, **ONE)
        assert said(stream, **ONE, reset=True)["action"] == 0
        assert [said(stream, **ONE)["action"] for _ in range(2)] == [0, 1]
        assert [binary(stream, counted(1))[0][0], binary(stream, counted(1, reset=True))[0][0]] == [1, 0]
        assert said(stream, **ONE, state=None)["action"] == 0, "null begins, too"
        signature = said(stream, reset=True)
        assert signature == {"reset": True} | {name: signature[name] for name in ("model", "version", "sha256")}
        assert [said(stream, **ONE)["action"] for _ in range(3)] == [0, 0, 1]
    with opened(unchanging, "memory") as stream:
        assert said(stream, observation=[3])["action"] == 1, "and not with another one"


def test_in_a_batch_each_row_has_its_own_state(unchanging: TestClient) -> None:
    rows = [[1], [2], [0]]
    with opened(unchanging, "memory") as stream:
        assert said(stream, observations=rows)["actions"] == [0, 0, 0]
        assert said(stream, observations=rows)["actions"] == [0, 1, 0]
        assert said(stream, observations=rows, reset=[False, True, False])["actions"] == [1, 0, 0]
        resets = REQUEST.pack(1, HAS_RESETS, 0, 3, 0) + b"\1\0\0" + np.array(rows, "<f4").tobytes()
        assert binary(stream, resets)[0].tolist() == [0, 1, 0]
        assert binary(stream, counted(3, amount=0))[0].tolist() == [0, 1, 0]
        assert said(stream, observations=rows, reset=[True] * 3)["actions"] == [0, 0, 0]
        error = told(stream, {"observations": rows[:2]})
        assert (error["code"], "needs a reset" in error["message"]) == ("invalid_state", True)
        assert said(stream, observations=rows)["actions"] == [0, 1, 0], "what is refused changes nothing"
        assert said(stream, observations=rows[:2], reset=True)["actions"] == [0, 0]
        assert said(stream, observation=[3], reset=True)["action"] == 1


def test_state_is_taken_along_as_a_token(unchanging: TestClient) -> None:
    with opened(unchanging, "memory") as stream:
        tokens = [said(stream, **ONE, return_state=True)["state"] for _ in range(2)]
        assert tokens[0] == act(unchanging, "memory", **ONE)["state"]
        batch = said(stream, observations=[[1], [2]], state=[tokens[1], None], return_state=True)
        assert (batch["actions"], len(batch["state"])) == ([1, 0], 2)
        assert said(stream, observations=[[0], [1]])["actions"] == [1, 1], "and is what the stream goes on with"
    with opened(unchanging, "memory") as other:
        assert said(other, **ONE, state=tokens[1])["action"] == 1
        assert act(unchanging, "memory", **ONE, state=tokens[1])["action"] == 1


def test_a_stream_is_pinned_for_its_life(client: TestClient, registry: Registry) -> None:
    registry.set_alias("board", "candidate", 3, expected=None, actor="test", reason="test")
    with ExitStack() as until_done:
        queries = ("", "?version=2", "?version=candidate")
        streams = [until_done.enter_context(opened(client, query=query)) for query in queries]
        promote(registry, "board", 2)
        registry.set_alias("board", "candidate", 1, expected=3, actor="test", reason="test")
        until(lambda: [act(client, version=alias, **BODY)["version"] for alias in ("champion", "candidate")] == [2, 1])
        assert [said(stream, **BODY)["version"] for stream in streams] == [1, 2, 3]
        assert [binary(stream, request(arrays([BOARD]), 1))[1] for stream in streams] == [1, 2, 3]


def test_a_stream_that_follows_answers_from_what_the_alias_names_now(client: TestClient, registry: Registry) -> None:
    expected = {version: masked_mlp(seed=version - 1) for version in (1, 2, 3)}
    (board,) = boards(1)
    batch = dict(zip(("observation", "action_mask"), arrays([board]), strict=True))
    with opened(client, query="?follow=champion") as stream:
        for version in (2, 3, 1):
            promote(registry, "board", version)
            until(lambda version=version: said(stream, observation=board)["version"] == version)
            actions, answered = binary(stream, request(arrays([board]), 1))
            assert (answered, actions.tolist()) == (version, OnnxPolicy(expected[version]).act(batch).actions.tolist())


def test_an_episode_stays_at_its_version_though_the_stream_follows(
    client: TestClient, registry: Registry, second: int
) -> None:
    with opened(client, "memory", "?follow=champion") as stream:
        token = said(stream, **ONE, return_state=True)["state"]
        promote(registry, "memory", second)
        until(lambda: act(client, "memory", **ONE)["version"] == second)
        assert [said(stream, **ONE)["version"] for _ in range(2)] == [1, 1]
        assert said(stream, observations=[[1]], state=[token])["version"] == 1
        assert said(stream, **ONE, reset=True)["version"] == second
        assert said(stream, **ONE, state=token)["version"] == 1, "back to where that episode is"
        assert said(stream, **ONE)["version"] == 1
        assert said(stream, reset=True)["version"] == second


def test_a_token_of_another_version_is_refused_where_the_version_is_pinned(client: TestClient, second: int) -> None:
    token = act(client, "memory", version=second, **ONE)["state"]
    with opened(client, "memory") as stream:
        said(stream, observation=[2])
        error = told(stream, ONE | {"state": token})
        assert (error["code"], error["status"]) == ("invalid_state", 400)
        assert f"version {second}" in error["message"]
        assert said(stream, **ONE)["action"] == 1, "its own episode goes on"


def test_a_key_s_canary_answers_streams_that_follow(client: TestClient, registry: Registry) -> None:
    setting = registry.set_traffic("board", canary=Portion(2, 1.0), actor="test", reason="test")
    until(lambda: [one.traffic for one in registry.acknowledgements("board")] == [setting.id])
    with (
        opened(client, query="?follow=champion", x_league_key="player") as with_key,
        opened(client, query="?follow=champion") as without,
        opened(client, query="?version=1", x_league_key="player") as pinned,
    ):
        assert [said(stream, **BODY)["version"] for stream in (with_key, without, pinned)] == [2, 1, 1]
        registry.set_traffic("board", canary=None, actor="test", reason="test")
        until(lambda: said(with_key, **BODY)["version"] == 1)


@pytest.mark.parametrize("name", sorted(BAD_BODIES.keys() - {"bytes"}))
def test_a_message_that_is_refused_does_not_end_the_stream(unchanging: TestClient, name: str) -> None:
    body, code, words = BAD_BODIES[name]
    text = body if isinstance(body, bytes) else json.dumps(body).encode()
    with opened(unchanging) as stream:
        error = told(stream, text.decode())
        assert error.keys() == {"code", "message", "status"}
        assert (error["code"], error["status"]) == (code, 400)
        assert words in error["message"]
        assert said(stream, **BODY)["version"] == 1


@pytest.mark.parametrize(
    ("message", "code", "words"),
    [
        (ONE | {"reset": 1}, "invalid_input", "reset is a number, expected true or false"),
        (ONE | {"reset": [True]}, "invalid_input", "reset is a list"),
        ({"observations": [[1]], "reset": [True, True]}, "invalid_input", "must hold 1"),
        ({"observations": [[1]], "reset": [1]}, "invalid_input", "must hold 1"),
        (ONE | {"return_state": "yes"}, "invalid_input", "return_state"),
        ({"reset": False}, "invalid_input", "neither observation nor observations"),
        ({"reset": True, "explore": True}, "invalid_input", "neither observation nor observations"),
        (ONE | {"state": {}}, "invalid_state", "a stream takes no arrays"),
        (ONE | {"state": "AQEA"}, "invalid_state", "no token"),
        (ONE | {"forget": True}, "invalid_input", "'forget'"),
        ({"observation": ["1"]}, "invalid_observation", "where a number"),
        ({"observations": [[1]] * 9}, "body_too_large", "at most 8"),
    ],
)
def test_what_streams_alone_can_get_wrong(unchanging: TestClient, message: Any, code: str, words: str) -> None:
    with opened(unchanging, "memory") as stream:
        said(stream, observation=[2])
        error = told(stream, message)
        assert error["code"] == code
        assert words in error["message"]
        assert said(stream, **ONE)["action"] == 1, "the state is as it was"


def test_reset_and_state_contradict_each_other(unchanging: TestClient) -> None:
    with opened(unchanging, "memory") as stream:
        token = said(stream, **ONE, return_state=True)["state"]
        assert told(stream, ONE | {"reset": True, "state": token})["code"] == "invalid_state"
    with opened(unchanging) as stream:
        error = told(stream, BODY | {"state": token})
        assert (error["code"], "not recurrent" in error["message"]) == ("invalid_state", True)


HEAD = REQUEST.pack(1, 0, 0, 1, 0)


@pytest.mark.parametrize(
    ("message", "code", "words"),
    [
        (b"", "invalid_input", "0 bytes, expected a head of 16"),
        (HEAD[:15], "invalid_input", "15 bytes"),
        (b"\2" + HEAD[1:], "invalid_input", "02 00 00 00"),
        (REQUEST.pack(1, 16, 0, 1, 0), "invalid_input", "01 10"),
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
def test_a_bad_binary_message_is_refused_in_a_sentence(
    unchanging: TestClient, message: bytes, code: str, words: str
) -> None:
    with opened(unchanging) as stream:
        stream.send_bytes(message)
        error = stream.receive_json()
        assert error["code"] == code
        assert words in error["message"]
        assert said(stream, **BODY)["version"] == 1


@pytest.mark.parametrize(
    ("model", "tensors", "words"),
    [
        ("vector", [np.array([np.nan, 0], "<f4")], "finite"),
        ("nested", [np.array([4], "<i8"), np.zeros(2, "<f4")], "observation.mode must be between 1 and 3"),
    ],
)
def test_values_are_checked_as_on_the_action_route(
    unchanging: TestClient, model: str, tensors: list[np.ndarray], words: str
) -> None:
    with opened(unchanging, model) as stream:
        stream.send_bytes(request(tensors, 1))
        error = stream.receive_json()
        assert error["code"] == "invalid_observation"
        assert words in error["message"]


@pytest.mark.parametrize(
    ("model", "query", "status", "code"),
    [
        ("nobody", "", 404, "unknown_league"),
        ("board", "?version=99", 404, "unknown_version"),
        ("board", "?follow=rival", 404, "unknown_alias"),
        ("board", "?follow=7", 400, "invalid_reference"),
        ("board", "?version=1&follow=champion", 400, "invalid_input"),
        ("board.other", "", 404, "unknown_policy"),
        ("duo", "", 404, "unknown_policy"),
        ("headless", "", 503, "not_ready"),
    ],
)
def test_what_cannot_be_opened(unchanging: TestClient, model: str, query: str, status: int, code: str) -> None:
    with pytest.raises(WebSocketDenialResponse) as caught, opened(unchanging, model, query):
        pass
    assert (caught.value.status_code, caught.value.json()["code"]) == (status, code)
    assert ("retry-after" in caught.value.headers) == (status == 503)


def test_a_version_that_was_retired_says_so(client: TestClient, registry: Registry) -> None:
    shutil.rmtree(registry.artifacts.path("board", 2))
    with pytest.raises(WebSocketDenialResponse) as caught, opened(client, query="?version=2"):
        pass
    assert (caught.value.status_code, caught.value.json()["code"]) == (410, "version_retired")


def test_more_streams_than_are_allowed_are_told_to_come_back(storage: Storage) -> None:
    with replica(storage, QUICK.model_copy(update={"max_streams": 1})) as client:
        for _ in range(2):
            with opened(client) as stream:
                said(stream, **BODY)
                with pytest.raises(WebSocketDenialResponse) as caught, opened(client):
                    pass
                assert (caught.value.status_code, caught.value.json()["code"]) == (429, "overloaded")


def ended(stream: WebSocketTestSession, message: Any) -> WebSocketDisconnect:
    """How a stream ends by a message, which until then is answered."""
    with pytest.raises(WebSocketDisconnect) as caught:
        until(lambda: said(stream, **message) and False)
    return caught.value


def test_a_key_that_is_revoked_ends_its_streams(client: TestClient, registry: Registry) -> None:
    _, token = registry.create_key("bot", ["act"])
    with opened(client) as before:
        until(lambda: client.post("/v1/policies/board/action", json=BODY).status_code == 401)
        end = ended(before, BODY)
        assert (end.code, end.reason) == (1008, "this stream needs an API key by now")
    with opened(client, x_api_key=token) as stream:
        said(stream, **BODY)
        registry.revoke_key("bot")
        end = ended(stream, BODY)
        assert (end.code, "bot was revoked" in end.reason) == (1008, True)


def test_each_message_counts_for_a_key_s_rate(registry: Registry) -> None:
    _, token = registry.create_key("slow", ["act"], rate=0.5)
    with replica(registry.storage) as client, opened(client, authorization=f"Bearer {token}") as stream:
        error = told(stream, BODY)
        assert (error["code"], error["status"], error["retry_after"]) == ("rate_limited", 429, 2)


def test_a_message_larger_than_a_body_may_be_ends_the_stream(unchanging: TestClient) -> None:
    with opened(unchanging) as stream:
        stream.send_text(" " * (64 * 1024 + 1))
        with pytest.raises(WebSocketDisconnect) as caught:
            stream.receive_text()
        assert caught.value.code == 1009


@pytest.fixture
def server(registry: Registry) -> Server:
    return Server(Registry.open(registry.storage), QUICK, "replica-1")


@pytest.fixture
def known(server: Server) -> Iterator[TestClient]:
    """The application of `server`, whose parts a test may break."""
    with TestClient(server.application()) as client:
        yield client


def test_a_standing_queue_is_cut(server: Server, known: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: Any) -> None:
        raise Overloaded("more than 64 requests wait here already")

    with opened(known) as stream:
        monkeypatch.setattr(type(server.doors.backlog), "admit", full)
        error = told(stream, BODY)
        assert (error["code"], error["status"], error["retry_after"]) == ("overloaded", 429, 1)
        monkeypatch.undo()
        said(stream, **BODY)


@pytest.mark.parametrize(
    ("fault", "code", "status"), [(MemoryError("no room"), "internal_error", 500), (LeagueError("so"), "error", 500)]
)
def test_a_fault_of_ours_does_not_end_the_stream(
    server: Server, known: TestClient, monkeypatch: pytest.MonkeyPatch, fault: Exception, code: str, status: int
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise fault

    with opened(known) as stream:
        champion = server.live.champion("board")
        assert champion is not None
        monkeypatch.setattr(champion.policies["shared"].policy, "act", broken)
        error = told(stream, BODY)
        assert (error["status"], "no room" in error["message"]) == (status, False)
        monkeypatch.undo()
        said(stream, **BODY)
    until(lambda: value(known, "league_errors_total", league="board", code=error["code"]) == 1)


def test_messages_are_counted(client: TestClient) -> None:
    with opened(client) as stream:
        until(lambda: value(client, "league_requests_in_flight", api="stream") == 1)
        for _ in range(3):
            said(stream, **BODY)
        binary(stream, request(arrays(boards(5)), 5))
        told(stream, {})
        told(stream, {})
    until(lambda: value(client, "league_request_seconds_count", api="stream") == 4)
    assert value(client, "league_request_seconds_count", policy="shared", version="1") == 4
    assert value(client, "league_batch_observations_sum", api="stream") == 8
    until(lambda: value(client, "league_errors_total", league="board", code="invalid_input") == 2)
    until(lambda: value(client, "league_requests_in_flight", api="stream") == 0)


def test_messages_are_shown_to_the_shadow(client: TestClient, registry: Registry) -> None:
    mirror(registry)
    asked = boards(12)
    with opened(client) as stream, opened(client, query="?version=3") as pinned:
        for board in asked[:4]:
            said(stream, observation=board)
            said(pinned, observation=board)
        binary(stream, request(arrays(asked[4:]), 8))
    found = wait_for(registry, lambda one: one.requests == 5)
    batch = dict(zip(("observation", "action_mask"), arrays(asked), strict=True))
    first, second = (OnnxPolicy(masked_mlp(seed=seed)).act(batch).actions for seed in (0, 1))
    assert (found.champion, found.observations) == (1, 12)
    assert found.agreed == int((first == second).sum())


def test_an_episode_that_has_begun_is_not_shown(client: TestClient, registry: Registry, second: int) -> None:
    mirror(registry, second, league="memory")
    with opened(client, "memory") as stream:
        for _ in range(3):
            said(stream, **ONE)
        said(stream, **ONE, reset=True)
    found = wait_for(registry, lambda one: one.requests + one.skipped == 4, league="memory")
    assert (found.requests, found.skipped) == (2, 2)


def test_a_slow_graph_holds_up_nobody(registry: Registry) -> None:
    """Rows beyond what is computed at once go to a thread, and come back to the same stream."""
    settings = QUICK.model_copy(update={"inline": 1e-9})
    with replica(registry.storage, settings) as client, opened(client, "memory") as stream:
        assert [said(stream, **ONE)["action"] for _ in range(4)] == [0, 0, 1, 1]
        assert binary(stream, counted(1))[0].tolist() == [1]
