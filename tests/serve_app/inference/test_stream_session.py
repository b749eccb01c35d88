"""Messages of a stream: their encoding, their answers, the state between them, and the version that answers."""

import shutil
from contextlib import ExitStack, closing
from functools import partial
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays as any_array
from hypothesis.extra.numpy import from_dtype
from starlette.testclient import TestClient, WebSocketDenialResponse, WebSocketTestSession
from starlette.websockets import WebSocketDisconnect

from league.errors import LeagueError, ObservationError, Overloaded
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Arrays
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from league.settings import Storage
from serve_app.access import api_keys
from serve_app.access.api_keys import TokenBucket
from serve_app.access.load_shedding import Backlog
from serve_app.inference.stream_codec import (
    HAS_RESETS,
    REQUEST,
    RESPONSE,
    BinaryRequest,
    binary_observations,
    encode_request,
    parse_request,
    write_actions,
)
from serve_app.live_versions.policies import ActionOptions, ActionSelections, LoadedPolicy
from serve_app.live_versions.version_cache import load
from tests.support.clients.actions import BOARD, act, board_arrays, boards
from tests.support.clients.streams import answer_to, open_stream, send
from tests.support.examples import examples
from tests.support.leagues.protocol_leagues import DTYPES
from tests.support.leagues.served_leagues import promote, publish
from tests.support.policies.graphs import counting, masked_mlp
from tests.support.servers.exposition import value
from tests.support.servers.replicas import QUICK, replica
from tests.support.servers.shadows import set_shadow, wait_for
from tests.support.waiting import until

ONE = {"observation": [1]}
BODY = {"observation": BOARD}


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
    return list(board_arrays(batch).values())


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
        together = binary(stream, encode_request(arrays(batch), 8, 3, explore=True))[0]
        assert together.tolist() == act(read_only_client, observations=batch, explore=True, seed=3)["actions"]
        alone = [binary(stream, encode_request(arrays([board]), 1, 5, explore=True))[0][0] for board in batch]
        assert alone == act(read_only_client, observations=batch, explore=True, seed=[5] * 8)["actions"]
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
        assert [binary(stream, counter_message(1, reset=reset))[0][0] for reset in (False, True)] == [1, 0]
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
    (board,) = boards(1)
    with open_stream(client, query="?follow=champion") as stream:
        for version in (2, 3, 1):
            promote(registry, "board", version)
            until(lambda version=version: answer_to(stream, observation=board)["version"] == version)
            actions, answered = binary(stream, encode_request(arrays([board]), 1))
            expected = OnnxPolicy(masked_mlp(seed=version - 1)).act(board_arrays([board])).actions
            assert (answered, actions.tolist()) == (version, expected.tolist())


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


INVALID_OPTIONS: tuple[tuple[dict[str, Any], str, str], ...] = (
    (ONE | {"reset": 1}, "invalid_input", "reset is a number, expected true or false"),
    (ONE | {"reset": [True]}, "invalid_input", "reset is a list"),
    ({"observations": [[1]], "reset": [True, True]}, "invalid_input", "must have 1"),
    ({"observations": [[1]], "reset": [1]}, "invalid_input", "must have 1"),
    (ONE | {"return_state": "yes"}, "invalid_input", "return_state"),
    ({"reset": False}, "invalid_input", "neither observation nor observations"),
    ({"reset": True, "explore": True}, "invalid_input", "neither observation nor observations"),
    (ONE | {"state": {}}, "invalid_state", "one string per observation"),
    (ONE | {"state": "AQEA"}, "invalid_state", "not a complete token"),
    (ONE | {"forget": True}, "invalid_input", "'forget'"),
    ({"observation": ["1"]}, "invalid_observation", "where a number"),
    ({"observations": [["1"]], "reset": [True]}, "invalid_observation", "where a number"),
    ({"observations": [[1]] * 9}, "body_too_large", "at most 8"),
)


def test_invalid_stream_options_are_rejected(read_only_client: TestClient, subtests: pytest.Subtests) -> None:
    with open_stream(read_only_client, "memory") as stream, open_stream(read_only_client) as other:
        token = answer_to(stream, **ONE, return_state=True)["state"]
        both = (ONE | {"reset": True, "state": token}, "invalid_state", "")
        for message, code, expected in (*INVALID_OPTIONS, both):
            with subtests.test(message=message):
                answer_to(stream, observation=[2], reset=True)
                error = send(stream, message)
                assert (error["code"], expected in error["message"]) == (code, True), error
                assert answer_to(stream, **ONE)["action"] == 1, "the state is unchanged"
        error = send(other, BODY | {"state": token})
        assert (error["code"], "expected board" in error["message"]) == ("invalid_state", True)


HEAD = REQUEST.pack(1, 0, 0, 1, 0)


NOT_FINITE = encode_request([np.array([np.nan, 0], "<f4")], 1)
OUT_OF_RANGE = encode_request([np.array([4], "<i8"), np.zeros(2, "<f4")], 1)
INVALID_MESSAGES = (
    ("board", b"", "invalid_input", "0 bytes, expected a header of 16"),
    ("board", HEAD[:15], "invalid_input", "15 bytes"),
    ("board", b"\2" + HEAD[1:], "invalid_input", "02 00 00 00"),
    ("board", REQUEST.pack(1, 32, 0, 1, 0), "invalid_input", "01 20"),
    ("board", REQUEST.pack(1, 17, 0, 1, 0), "invalid_input", "not both"),
    ("board", REQUEST.pack(1, 0, 1, 1, 0), "invalid_input", "expected 01"),
    ("board", REQUEST.pack(1, 0, 0, 0, 0), "invalid_input", "0 rows"),
    ("board", REQUEST.pack(1, 0, 0, 9, 0), "body_too_large", "1 to 8"),
    ("board", REQUEST.pack(1, 2, 0, 1, 2**63), "invalid_input", "seed"),
    ("board", REQUEST.pack(1, 0, 0, 1, 7), "invalid_input", "seed"),
    ("board", REQUEST.pack(1, 8, 0, 2, 0) + b"\0", "invalid_input", "2 bytes of 0 or 1"),
    ("board", REQUEST.pack(1, 8, 0, 2, 0) + b"\0\2", "invalid_input", "2 bytes of 0 or 1"),
    ("board", HEAD, "invalid_observation", "0 bytes, expected 91: 1 rows of 84 observation + 7 action_mask"),
    ("board", HEAD + bytes(90), "invalid_observation", "90 bytes"),
    ("board", HEAD + bytes(91), "illegal_mask", "at least one"),
    ("vector", NOT_FINITE, "invalid_observation", "finite"),
    ("nested", OUT_OF_RANGE, "invalid_observation", "observation.mode must be between 1 and 3"),
)


def test_an_invalid_binary_message_is_rejected(read_only_client: TestClient, subtests: pytest.Subtests) -> None:
    with ExitStack() as stack:
        models = ("board", "vector", "nested")
        streams = {model: stack.enter_context(open_stream(read_only_client, model)) for model in models}
        for model, message, code, expected in INVALID_MESSAGES:
            with subtests.test(message=message[:20]):
                streams[model].send_bytes(message)
                error = streams[model].receive_json()
                assert (error["code"], expected in error["message"]) == (code, True), error
        assert answer_to(streams["board"], **BODY)["version"] == 1


def denied(client: TestClient, query: str = "", model: str = "board", **headers: str) -> WebSocketDenialResponse:
    """The response to a stream that is not opened."""
    with pytest.raises(WebSocketDenialResponse) as caught, open_stream(client, model, query, **headers):
        pass
    return caught.value


def test_a_stream_that_cannot_be_opened_is_rejected(read_only_client: TestClient, subtests: pytest.Subtests) -> None:
    for model, query, status, code in (
        ("nobody", "", 404, "unknown_league"),
        ("board", "?version=99", 404, "unknown_version"),
        ("board", "?follow=rival", 404, "unknown_alias"),
        ("board", "?follow=7", 400, "invalid_reference"),
        ("board", "?version=best&follow=champion", 400, "invalid_input"),
        ("board.other", "", 404, "unknown_policy"),
        ("duo", "", 404, "unknown_policy"),
        ("headless", "", 503, "not_ready"),
    ):
        with subtests.test(model=model, query=query):
            response = denied(read_only_client, query, model)
            assert (response.status_code, response.json()["code"]) == (status, code)
            assert ("retry-after" in response.headers) == (status == 503)


def test_the_number_of_streams_is_limited(storage: Storage) -> None:
    with replica(storage, QUICK.model_copy(update={"max_streams": 1})) as client:
        for _ in range(2):
            with open_stream(client) as stream:
                answer_to(stream, **BODY)
                response = denied(client)
                assert (response.status_code, response.json()["code"]) == (429, "overloaded")


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


def test_each_message_counts_for_the_rate_limit_of_a_key(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_keys, "TokenBucket", partial(TokenBucket, clock=lambda: 0.0))  # no time passes
    _, token = registry.keys.create("slow", ["act"], rate=0.5)
    with replica(registry.storage) as client, open_stream(client, authorization=f"Bearer {token}") as stream:
        error = send(stream, BODY)
        assert (error["code"], error["status"], error["retry_after"]) == ("rate_limited", 429, 2)


def test_neither_a_full_queue_nor_an_internal_error_ends_a_stream(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(registry.artifacts.path("board", 2))
    with replica(registry.storage) as client, open_stream(client) as stream:
        response = denied(client, "?version=2")
        assert (response.status_code, response.json()["code"]) == (410, "version_retired")
        for owner, function, fault, code, status in (
            (Backlog, "admit", Overloaded("more than 64 requests wait"), "overloaded", 429),
            # Not of one policy: a replica that is slow for a moment runs another.
            (OnnxPolicy, "act", MemoryError("no room"), "internal_error", 500),
            (OnnxPolicy, "act", LeagueError("so"), "league_error", 500),
        ):
            with monkeypatch.context() as patch:
                patch.setattr(owner, function, Mock(side_effect=fault))
                error = send(stream, BODY)
            assert (error["code"], error["status"], error.get("retry_after")) == (
                code,
                status,
                1 if status == 429 else None,
            )
            assert "no room" not in error["message"]
            answer_to(stream, **BODY)
            if status == 500:
                until(lambda code=code: value(client, "league_errors_total", league="board", code=code) == 1)


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
    counts = wait_for(registry, lambda one: one.requests == 5)
    first, second = (OnnxPolicy(masked_mlp(seed=seed)).act(board_arrays(observations)).actions for seed in (0, 1))
    assert (counts.champion, counts.observations) == (1, 12)
    assert counts.agreed == int((first == second).sum())


MAX_ROWS = 64
"""Maximum number of rows in a message."""


@pytest.fixture(scope="module")
def policies(leagues: Storage) -> dict[str, LoadedPolicy]:
    with closing(Registry.open(leagues)) as registry:
        return {
            league: load(registry, league, 1, inline=1, selections=ActionSelections()).policy(None)
            for league in ("kinds", "board", "vector", "chess", "memory")
        }


def leaves(dtype: str, rows: int) -> st.SearchStrategy[np.ndarray]:
    """Arrays of any bytes, without NaN and infinity: requests may contain neither."""
    shape, kind = (rows, 2, 3), np.dtype(dtype)
    size = int(np.prod(shape)) * kind.itemsize

    def array(content: bytes) -> np.ndarray:
        if kind.kind == "b":
            return (np.frombuffer(content, np.uint8) & 1).astype(bool).reshape(shape)
        values = np.frombuffer(content, kind).reshape(shape)
        return np.where(np.isfinite(values), values, kind.type(0)) if kind.kind == "f" else values

    return st.binary(min_size=size, max_size=size).map(array)


@st.composite
def request_data(draw: st.DrawFn) -> dict[str, Any]:
    rows = draw(st.integers(1, 3))
    return {
        "rows": rows,
        "seed": draw(st.none() | st.integers(0, 2**63 - 1)),
        "explore": draw(st.none() | st.booleans()),
        "reset": draw(st.booleans()),
        "tensors": [draw(leaves(dtype, rows)) for dtype in DTYPES],
    }


def decode(policy: LoadedPolicy, request: BinaryRequest) -> Arrays:
    observations = binary_observations(policy, request)
    return observations.read(policy, [observations])


@examples(50)
@given(data=request_data(), has_resets=st.booleans())
def test_requests_survive_encoding(policies: dict[str, LoadedPolicy], data: dict[str, Any], has_resets: bool) -> None:
    names = [port.name for port in policies["kinds"].observed]
    assert names == [tensor.name for tensor in policies["kinds"].manifest.inputs]
    by_dtype = dict(zip(DTYPES, data["tensors"], strict=True))
    tensors = [by_dtype[name.removeprefix("observation.")] for name in names]
    message = encode_request(**(data | {"tensors": tensors}))
    if has_resets:  # makes the tensors unaligned
        message = bytes((1, message[1] | HAS_RESETS)) + message[2:16] + bytes(data["rows"]) + message[16:]
    read = parse_request(message, MAX_ROWS)
    assert read.options == ActionOptions(data["explore"], data["seed"])
    assert (read.rows, read.reset) == (data["rows"], data["reset"])
    assert (read.resets is not None) == has_resets
    decoded = decode(policies["kinds"], read)
    assert list(decoded) == names
    for name, tensor in zip(names, tensors, strict=True):
        np.testing.assert_array_equal(decoded[name], tensor)
        assert decoded[name].dtype == tensor.dtype
        assert decoded[name].flags.aligned


@examples(50)
@given(resets=st.lists(st.booleans(), min_size=1, max_size=MAX_ROWS))
def test_resets_are_parsed(policies: dict[str, LoadedPolicy], resets: list[bool]) -> None:
    rows = len(resets)
    observation = np.arange(rows, dtype="<f4").reshape(rows, 1)
    message = REQUEST.pack(1, HAS_RESETS, 0, rows, 0) + bytes(resets) + observation.tobytes()
    read = parse_request(message, MAX_ROWS)
    assert read.resets is not None
    assert read.resets.tolist() == resets
    np.testing.assert_array_equal(decode(policies["memory"], read)["observation"], observation)


@examples(50)
@given(rows=st.integers(1, MAX_ROWS), version=st.integers(1, 2**32 - 1), data=st.data())
def test_replies_contain_the_actions(
    policies: dict[str, LoadedPolicy], rows: int, version: int, data: st.DataObject
) -> None:
    for league, dtype, shape in (("board", "<i8", (rows,)), ("vector", "<f4", (rows, 2))):
        numbers = {"allow_nan": False} if dtype == "<f4" else {}
        actions = data.draw(any_array(np.dtype(dtype), shape, elements=from_dtype(np.dtype(dtype), **numbers)))
        policies[league].number = version
        reply = write_actions(policies[league], actions)
        assert RESPONSE.unpack_from(reply) == (1, 0, 0, rows, version, 0)
        np.testing.assert_array_equal(np.frombuffer(reply, dtype, offset=16).reshape(shape), actions)


def test_a_header_has_the_documented_layout() -> None:
    message = encode_request([np.array([1, 2], "<u2")], 2, seed=0x0102030405060708, explore=True, reset=True)
    assert message.hex(" ") == "01 07 00 00 02 00 00 00 08 07 06 05 04 03 02 01 01 00 02 00"


def test_bytes_of_a_boolean_are_0_and_1(policies: dict[str, LoadedPolicy]) -> None:
    planes, mask = np.zeros((1, 8, 8, 111), np.uint8), np.ones((1, 4672), np.int8)
    decode(policies["chess"], parse_request(encode_request([planes, mask], 1), MAX_ROWS))
    planes[0, 3, 3, 3] = 2
    with pytest.raises(ObservationError, match="other than 0 and 1"):
        decode(policies["chess"], parse_request(encode_request([planes, mask], 1), MAX_ROWS))
