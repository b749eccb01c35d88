"""Requests generated from the OpenAPI document, and binary messages: none causes a server error, with either database.

Generated requests conform to the document or violate it; each response must be one of those documented.
PostgreSQL limits the length of names, has 32-bit integers and refuses NUL characters in text; SQLite does not.
"""

import gzip
import json
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis.checks import CHECKS, load_all_checks
from schemathesis.schemas import APIOperation
from starlette.testclient import TestClient

from league.registry.registry import Registry
from league.settings import Storage
from league.spaces import inputs
from serve_app.inference.stream_codec import FRAMING, REQUEST
from serve_app.live_versions.policies import ActionSelections, LoadedPolicy
from serve_app.live_versions.version_cache import load
from serve_app.openapi.document import document
from tests.support.examples import examples
from tests.support.generated_requests import OPERATIONS, draw_request
from tests.support.leagues.match_results import SCHEDULE, WON
from tests.support.leagues.protocol_leagues import every_kind
from tests.support.servers.replicas import QUICK, READ_ONLY, replica
from tests.support.servers.two_databases import ReplicasOfBoth, is_available, outline, replicas_of_both

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
def replicas(tmp_path_factory: pytest.TempPathFactory, postgresql_socket: Path) -> Iterator[ReplicasOfBoth]:
    """Replicas of equal leagues, one for each database, with a key for all scopes."""
    with replicas_of_both(tmp_path_factory.mktemp("databases"), postgresql_socket) as replicas:
        yield replicas


@pytest.mark.parametrize("operation", OPERATIONS, ids=lambda operation: operation.label.replace("/", " "))
def test_each_response_is_documented_and_the_same_with_both_databases(
    replicas: ReplicasOfBoth, operation: APIOperation
) -> None:
    """Most requests are for actions, whose observations have many forms."""

    @settings(examples(60 if operation.path == "/v1/policies/{model}/action" else 8), **SEVERAL)
    @given(data=st.data())
    def check(data: st.DataObject) -> None:
        drawn = draw_request(data, operation)
        response, other = replicas.responses(drawn.method, drawn.url, drawn.content, drawn.headers)
        status, code, _ = outline(response)
        assert outline(response) == outline(other)
        assert is_available(status, code), response.text
        if status not in (404, 405) and operation.path != "/v1/policies/{model}/stream":
            drawn.case.validate_response(response, checks=CONFORMS)

    check()


MODELS = ("board", "memory", "nested", "kinds", "choice", "vector")


@pytest.fixture(scope="module")
def registry_of_models(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    registry = every_kind(Storage.at(tmp_path_factory.mktemp("models")))
    yield registry
    registry.close()


@pytest.fixture(scope="module")
def client(registry_of_models: Registry) -> Iterator[TestClient]:
    with replica(registry_of_models.storage, READ_ONLY) as client:
        yield client


@pytest.fixture(scope="module")
def policies(registry_of_models: Registry) -> dict[str, LoadedPolicy]:
    load_first = partial(load, registry_of_models, number=1, inline=0.001, selections=ActionSelections())
    return {model: load_first(league=model).policy(None) for model in MODELS}


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


def binary_inference(policy: LoadedPolicy, rows: int, data: st.DataObject) -> tuple[bytes, int]:
    """A body, and the length of its JSON header."""
    ports, parts, listed = policy.inputs, [], []
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


@settings(examples(200), **SEVERAL)
@given(data=st.data())
def test_a_binary_inference_is_answered_or_rejected(
    client: TestClient, policies: dict[str, LoadedPolicy], data: st.DataObject
) -> None:
    model, encoding = (
        data.draw(st.sampled_from(MODELS)),
        data.draw(st.sampled_from(["identity", "gzip", "deflate", "br"])),
    )
    valid, length = binary_inference(policies[model], data.draw(st.integers(1, 4)), data)
    body = data.draw(damaged(valid) | st.binary(max_size=64))
    lengths = st.just(length) | st.integers(0, 2 * length) | st.sampled_from(["-1", "", "9" * 11, "0"])
    headers = {
        "inference-header-content-length": str(data.draw(lengths)),
        "content-encoding": encoding,
        "accept-encoding": data.draw(st.sampled_from(["", "gzip", "deflate;q=0, gzip", "*", ";;,,"])),
    }
    compress = {"gzip": gzip.compress, "deflate": zlib.compress}.get(encoding, bytes)
    version = data.draw(st.sampled_from(["", "/versions/1", "/versions/champion", "/versions/99", "/versions/x y"]))
    reply = client.post(f"/v2/models/{model}{version}/infer", content=compress(body), headers=headers)
    assert reply.status_code < 500, reply.text
    if reply.status_code != 200:
        assert reply.json().keys() == {"error"}
        is_valid = (body, headers["inference-header-content-length"]) == (valid, str(length))
        assert not is_valid or encoding == "br" or version[-1:] in ("9", "y")


def test_a_stream_survives_any_messages(client: TestClient, policies: dict[str, LoadedPolicy]) -> None:
    """Valid and invalid messages, text and binary, on one stream of each model: none causes a server error."""
    texts = damaged(b'{"observation": [1], "reset": true}').map(lambda text: text.decode("utf-8", "replace"))
    with ExitStack() as stack:
        streams = {
            model: stack.enter_context(client.websocket_connect(f"/v1/policies/{model}/stream")) for model in MODELS
        }

        @settings(examples(250), **SEVERAL)
        @given(data=st.data())
        def converse(data: st.DataObject) -> None:
            model, rows, flags = (
                data.draw(st.sampled_from(MODELS)),
                data.draw(st.integers(1, 4)),
                data.draw(st.integers(0, 15)),
            )
            tensors = zeros(policies[model], rows).values()
            resets = bytes(data.draw(st.lists(st.integers(0, 1), min_size=rows, max_size=rows))) if flags & 8 else b""
            head = REQUEST.pack(FRAMING, flags, 0, rows, 7 if flags & 2 else 0)
            whole = head + resets + b"".join(array.astype(array.dtype.newbyteorder("<")).tobytes() for array in tensors)
            message = data.draw(damaged(whole) | st.binary(max_size=64) | texts)
            (streams[model].send_text if isinstance(message, str) else streams[model].send_bytes)(message)
            answer = streams[model].receive()
            assert answer["type"] == "websocket.send", answer
            if answer.get("text") is not None:
                error = json.loads(answer["text"])
                assert error.get("status", 200) < 500, answer
                assert len(error.get("message", "")) < 2000
                needs_reset = "a reset is required" in error.get("message", "")  # after messages with other rows
                assert message != whole or needs_reset, answer

        converse()
        streams["memory"].send_text('{"observation": [1], "reset": true}')
        assert streams["memory"].receive_json()["action"] == 0


UNUSUAL = ("a\0b", "x" * 101, "x" * 301, "x" * 5000, "-1", "0", str(2**31), str(2**63), "9" * 40, "é", "Board", "²")
PATH = {
    "league": "board",
    "alias": "champion",
    "version": "1",
    "evaluation": "1",
    "verdict": WON,
    "schedule": SCHEDULE.id,
    "position": "0",
    "game": "0",
    "run": "first",
}
CHANGES = {
    "/v1/leagues/board/aliases/candidate": {"version": 1, "expected": None, "reason": "a test"},
    "/v1/leagues/board/rollback": {"expected": 3, "reason": "a test"},
    "/v1/leagues/board/traffic": {"canary": {"version": 2, "share": 0.5}, "shadow": None, "reason": "a test"},
    "/v1/leagues/board/versions/1/note": {"note": "a test"},
}
VALUES = ("", "a\0b", "x" * 3000, "\ud800", "😀", 0, -1, 2**31, 2**63, 10**400, 1.5, True, None, [], {}, "1")


def answers(replicas: ReplicasOfBoth, method: str, path: str, content: bytes | None = None) -> tuple[int, str | None]:
    """The status and the code of the error, which must be equal."""
    responses = replicas.responses(method, path, content, {"idempotency-key": str(hash((path, content)))})
    outlines = [outline(response) for response in responses]
    assert outlines[0] == outlines[1], (method, path, content)
    return outlines[0][:2]


def reads() -> list[tuple[str, list[str]]]:
    """The paths that are read, and their query parameters."""
    operations = ((path, calls["get"]) for path, calls in document(QUICK, [])["paths"].items() if "get" in calls)
    return [
        (path, [query["name"] for query in call.get("parameters", []) if query.get("in") == "query"])
        for path, call in operations
        if path.startswith("/v1/leagues/") and not path.endswith("/events")
    ]


@pytest.mark.parametrize(("path", "parameters"), reads(), ids=lambda part: part if isinstance(part, str) else "")
def test_unusual_parameters(replicas: ReplicasOfBoth, path: str, parameters: list[str]) -> None:
    usual = path.format_map(PATH)
    assert answers(replicas, "GET", usual)[0] in (200, 404, 503)
    for value in UNUSUAL:
        for name in (name for name in PATH if f"{{{name}}}" in path):
            status, _ = answers(replicas, "GET", path.format_map(PATH | {name: quote(value, safe="")}))
            assert status in (200, 400, 404, 422, 503), (name, value)
        for name in parameters:
            status, _ = answers(replicas, "GET", f"{usual}?{name}={quote(value, safe='')}")
            assert status in (200, 400, 404, 503), (name, value)


@pytest.mark.parametrize("path", CHANGES)
def test_unusual_changes(replicas: ReplicasOfBoth, path: str) -> None:
    body = CHANGES[path]
    method = "PUT" if path.endswith("note") else "POST"
    for field in body:
        for value in VALUES:
            status, _ = answers(replicas, method, path, json.dumps(body | {field: value}).encode())
            assert status in (200, 400, 404, 409), (field, value)
    for value in UNUSUAL:
        changed = path.replace("board", quote(value, safe=""))
        status, _ = answers(replicas, method, changed, json.dumps(body).encode())
        assert status in (400, 404, 405), value


def test_names_of_aliases(replicas: ReplicasOfBoth) -> None:
    """A name that one database cannot store is accepted by none."""
    for name in ("candidate", "x" * 100, "x" * 101, "x" * 300, "1", "a\0b", "Ä"):
        status, _ = answers(replicas, "POST", f"/v1/leagues/board/aliases/{quote(name)}", b'{"version": 2}')
        assert status == (200 if name in ("candidate", "x" * 100) else 400), name
