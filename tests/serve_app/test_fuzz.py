"""Requests generated from the OpenAPI document, and binary messages from their format: none causes a server error.

Generated requests conform to the document or violate it; each response must be one of those documented.
"""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis.checks import CHECKS, load_all_checks
from schemathesis.schemas import APIOperation
from starlette.testclient import TestClient

from league.errors import LeagueError
from league.registry.keys import SCOPES
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces import inputs
from serve_app.access.errors import status_of
from serve_app.inference.stream_codec import FRAMING, REQUEST, BinaryCodec, parse_request
from serve_app.inference_protocol.inference import InferResponse
from serve_app.inference_protocol.rest_codec import read_request, write_response
from serve_app.inference_protocol.tensors import read_inputs, signature_of
from serve_app.live_versions.version_cache import ActionSelections, LoadedPolicy, load
from tests.support.examples import examples
from tests.support.generated_requests import OPERATIONS, draw_request
from tests.support.leagues.match_results import record
from tests.support.leagues.protocol_leagues import every_kind
from tests.support.servers.replicas import replica
from tests.support.waiting import until

load_all_checks()
CONFORMS = CHECKS.get_by_names(
    [
        "status_code_conformance",
        "content_type_conformance",
        "response_headers_conformance",
        "response_schema_conformance",
    ]
)
SEVERAL: dict[str, Any] = {"suppress_health_check": list(HealthCheck)}


@pytest.fixture(scope="module")
def storage_to_fuzz(tmp_path_factory: pytest.TempPathFactory) -> Storage:
    storage = Storage.at(tmp_path_factory.mktemp("fuzz"))
    registry = every_kind(storage)
    record(registry)
    registry.close()
    return storage


@pytest.fixture(scope="module")
def fuzzed(storage_to_fuzz: Storage) -> Iterator[TestClient]:
    """A replica with a client key for all scopes. The served versions change during the test."""
    registry = Registry.open(storage_to_fuzz)
    _, token = registry.keys.create("fuzz", SCOPES)
    registry.close()
    with replica(storage_to_fuzz) as client:
        client.headers["x-api-key"] = token
        until(lambda: client.get("/v1/leagues").status_code == 200)
        yield client


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda each: each.label.replace("/", " "))
@settings(examples(8), **SEVERAL)
@given(data=st.data())
def test_each_response_is_documented(fuzzed: TestClient, operation: APIOperation, data: st.DataObject) -> None:
    drawn = draw_request(data, operation)
    reply = fuzzed.request(drawn.method, drawn.url, headers=drawn.headers, content=drawn.content)
    assert reply.status_code < 500 or _is_not_ready(reply), reply.text
    if reply.status_code not in (404, 405) and operation.path != "/v1/policies/{model}/stream":
        drawn.case.validate_response(reply, checks=CONFORMS)


def _is_not_ready(reply: Any) -> bool:
    """Whether there is no champion, or the request needs the unavailable evaluation service."""
    return reply.status_code == 503 and (b"no champion" in reply.content or b"no_evaluation_service" in reply.content)


MODELS = ("board", "memory", "nested", "kinds", "choice", "vector")


@pytest.fixture(scope="module")
def policies(storage_to_fuzz: Storage) -> dict[str, LoadedPolicy]:
    registry = Registry.open(storage_to_fuzz)
    loaded = {
        model: load(registry, model, 1, inline=0.001, selections=ActionSelections()).policy(None) for model in MODELS
    }
    registry.close()
    return loaded


def zeros(policy: LoadedPolicy, rows: int) -> dict[str, np.ndarray]:
    """Valid observations of zeros, with all actions legal."""
    arrays = policy.reader.zeros(rows)
    for name, leaf in inputs(policy.manifest.observation).items():
        arrays[name] = arrays[name] + np.asarray(getattr(leaf, "start", 0), arrays[name].dtype)
    return arrays


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """A message with a few bytes changed, removed or inserted."""
    message = bytearray(whole)
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(message)))
        message[at : at + draw(st.sampled_from([0, 1, 4, 1000]))] = draw(st.binary(max_size=8))
    return bytes(message)


def is_client_error(error: LeagueError) -> bool:
    """Whether an error is the client's, with a message of reasonable length."""
    return status_of(error) < 500 and 0 < len(str(error)) < 2000


@settings(examples(400), **SEVERAL)
@given(data=st.data())
def test_a_binary_message_of_a_stream_is_parsed_or_rejected(
    policies: dict[str, LoadedPolicy], data: st.DataObject
) -> None:
    policy = policies[data.draw(st.sampled_from(MODELS))]
    framing, rows = BinaryCodec(policy), data.draw(st.integers(1, 4))
    flags = data.draw(st.integers(0, 15))
    tensors = b"".join(array.astype(array.dtype.newbyteorder("<")).tobytes() for array in zeros(policy, rows).values())
    resets = bytes(data.draw(st.lists(st.integers(0, 1), min_size=rows, max_size=rows))) if flags & 8 else b""
    whole = REQUEST.pack(FRAMING, flags, 0, rows, 7 if flags & 2 else 0) + resets + tensors
    message = data.draw(damaged(whole) | st.binary(max_size=64))
    try:
        ask = parse_request(message, max_batch=8)
        arrays = framing.read(ask)
    except LeagueError as error:
        assert is_client_error(error)  # noqa: PT017
        assert message != whole
        return
    answer = policy.policy.act(arrays, explore=ask.explore, rng=[np.random.default_rng(0)] * ask.rows)
    assert len(framing.write(answer.actions, 1)) == 16 + answer.actions.nbytes


@settings(examples(400), **SEVERAL)
@given(data=st.data())
def test_a_binary_inference_is_parsed_or_rejected(policies: dict[str, LoadedPolicy], data: st.DataObject) -> None:
    policy = policies[data.draw(st.sampled_from(MODELS))]
    valid, length = binary_inference(policy, data.draw(st.integers(1, 4)), data)
    body = data.draw(damaged(valid) | st.binary(max_size=64))
    header_length = data.draw(st.just(length) | st.none() | st.integers(0, 2 * length))
    try:
        request = read_request("board", "", body, header_length)
        arrays = read_inputs(request.infer.inputs, signature_of(policy.manifest), max_batch=8)
    except LeagueError as error:
        assert is_client_error(error)  # noqa: PT017
        assert (body, header_length) != (valid, length)
        return
    outputs = {"action": policy.policy.act(arrays).actions}
    reply, found = write_response(InferResponse("board", "1", request.infer.id, outputs), request)
    assert json.loads(reply[:found])["outputs"][0]["name"] == "action"


def binary_inference(policy: LoadedPolicy, rows: int, data: st.DataObject) -> tuple[bytes, int]:
    """A body, and the length of its JSON header."""
    ports, parts, listed = signature_of(policy.manifest).inputs, [], []
    for name, array in zeros(policy, rows).items():
        document = {"name": name, "datatype": ports[name].datatype, "shape": list(array.shape)}
        if data.draw(st.booleans()):
            listed.append(document | {"data": array.ravel().tolist()})
        else:
            parts.append(array.astype(array.dtype.newbyteorder("<")).tobytes())
            listed.append(document | {"parameters": {"binary_data_size": len(parts[-1])}})
    outputs = [{"name": "action", "parameters": {"binary_data": data.draw(st.booleans())}}]
    head = json.dumps({"id": "1", "inputs": listed, "outputs": outputs}).encode()
    return b"".join((head, *parts)), len(head)


@settings(examples(150), **SEVERAL)
@given(data=st.data())
def test_a_binary_inference_over_http_is_answered_or_rejected(
    fuzzed: TestClient, policies: dict[str, LoadedPolicy], data: st.DataObject
) -> None:
    model = data.draw(st.sampled_from(MODELS))
    valid, length = binary_inference(policies[model], data.draw(st.integers(1, 4)), data)
    headers = {
        "inference-header-content-length": data.draw(st.just(str(length)) | st.sampled_from(["-1", "", "9" * 11, "0"])),
        "content-encoding": data.draw(st.sampled_from(["identity", "gzip", "deflate", "br"])),
        "accept-encoding": data.draw(st.sampled_from(["", "gzip", "deflate;q=0, gzip", "*", ";;,,"])),
    }
    reply = fuzzed.post(f"/v2/models/{model}/infer", content=data.draw(damaged(valid)), headers=headers)
    assert reply.status_code < 500, reply.text
    assert reply.status_code == 200 or reply.json().keys() == {"error"}


def test_a_stream_survives_any_messages(fuzzed: TestClient, policies: dict[str, LoadedPolicy]) -> None:
    """Valid and invalid messages, text and binary, on one stream: each is answered without a server error."""
    valid = REQUEST.pack(FRAMING, 0, 0, 1, 0) + np.ones(1, "<f4").tobytes()

    with fuzzed.websocket_connect("/v1/policies/memory/stream") as stream:

        @settings(examples(300), **SEVERAL)
        @given(
            message=damaged(valid) | st.binary(max_size=40) | damaged(b'{"observation": [1], "reset": true}').map(_text)
        )
        def converse(message: bytes | str) -> None:
            if isinstance(message, str):
                stream.send_text(message)
            else:
                stream.send_bytes(message)
            answer = stream.receive()
            assert answer["type"] == "websocket.send", answer
            if answer.get("text") is not None:
                assert json.loads(answer["text"]).get("status", 200) < 500, answer

        converse()
        stream.send_text('{"observation": [1], "reset": true}')
        assert stream.receive_json()["action"] == 0


def _text(message: bytes) -> str:
    return message.decode("utf-8", "replace")
