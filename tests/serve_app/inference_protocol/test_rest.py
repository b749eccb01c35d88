"""REST without a client library: exact documents of the protocol, and invalid bodies."""

import gzip
import json
import zlib
from collections.abc import Iterator
from functools import partial
from typing import Any

import httpx
import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient

from league.errors import StorageError
from league.registry.versions import VersionRepository
from league.settings import Storage
from tests.support.examples import examples
from tests.support.leagues.served_leagues import everything, promote
from tests.support.servers.protocol_servers import SETTINGS
from tests.support.servers.replicas import QUICK
from tests.support.servers.replicas import replica as application
from tests.support.waiting import until

LENGTH = "Inference-Header-Content-Length"
VECTOR = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "data": [0.5, -1]}
NAME = {"type": "string"}
TENSORS = {
    "type": "array",
    "items": {
        "type": "object",
        "properties": {"name": NAME, "datatype": NAME, "shape": {"type": "array", "items": {"type": "integer"}}},
        "required": ["name", "datatype", "shape"],
        "additionalProperties": False,
    },
}
DURATION = {
    "type": "object",
    "properties": {"count": {"type": "integer"}, "ns": {"type": "integer"}},
    "required": ["count", "ns"],
    "additionalProperties": False,
}
DURATIONS = ("success", "fail", "queue", "compute_input", "compute_infer", "compute_output", "cache_hit", "cache_miss")


def exact(**properties: Any) -> dict[str, Any]:
    """The schema of an object with exactly these properties."""
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


SCHEMAS: dict[str, dict[str, Any]] = {
    "/v2": exact(name=NAME, version=NAME, extensions={"type": "array", "items": NAME}),
    "/v2/health/live": exact(live={"const": True}),
    "/v2/health/ready": exact(ready={"const": True}),
    "/v2/models/board/ready": exact(name={"const": "board"}, ready={"const": True}),
    "/v2/models/board": exact(
        name={"const": "board"},
        versions={"type": "array", "items": NAME},
        platform={"const": "onnxruntime_onnx"},
        inputs=TENSORS,
        outputs=TENSORS,
    ),
    "/v2/models/stats": exact(
        model_stats={
            "type": "array",
            "items": exact(
                name=NAME,
                version=NAME,
                last_inference={"type": "integer"},
                inference_count={"type": "integer"},
                execution_count={"type": "integer"},
                inference_stats=exact(**dict.fromkeys(DURATIONS, DURATION)),
            ),
        }
    ),
}
SCHEMAS |= {
    "/v2/models/board/versions/champion": SCHEMAS["/v2/models/board"],
    "/v2/models/board/versions/2": SCHEMAS["/v2/models/board"],
    "/v2/models/board/versions/2/ready": SCHEMAS["/v2/models/board/ready"],
    "/v2/models/board/stats": SCHEMAS["/v2/models/stats"],
    "/v2/models/board/versions/3/stats": SCHEMAS["/v2/models/stats"],
}
RESPONSE = exact(
    model_name={"const": "vector"},
    model_version={"const": "1"},
    id={"const": "tick"},
    outputs={
        "type": "array",
        "items": exact(
            name=NAME,
            datatype=NAME,
            shape={"type": "array", "items": {"type": "integer"}},
            data={"type": "array", "items": {"type": "number"}},
        ),
    },
)
ERROR = exact(error={"type": "string", "minLength": 1})


@pytest.fixture(scope="module")
def client(leagues: Storage) -> Iterator[TestClient]:
    with application(leagues, SETTINGS) as client:
        yield client


def infer(client: TestClient, body: Any, model: str = "vector", **headers: str) -> httpx.Response:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return client.post(f"/v2/models/{model}/infer", content=content, headers=headers)


def error_of(reply: httpx.Response, status: int = 400) -> str:
    assert reply.status_code == status, reply.text
    jsonschema.validate(reply.json(), ERROR)
    return str(reply.json()["error"])


@pytest.mark.parametrize("path", SCHEMAS)
def test_documents_follow_the_protocol(client: TestClient, path: str) -> None:
    assert infer(client, {"inputs": [VECTOR]}).status_code == 200
    reply = client.get(path)
    assert reply.status_code == 200
    jsonschema.validate(reply.json(), SCHEMAS[path])


def test_an_inference_response_follows_the_protocol(client: TestClient) -> None:
    reply = infer(client, {"id": "tick", "inputs": [VECTOR], "outputs": [{"name": "action"}]})
    jsonschema.validate(reply.json(), RESPONSE)
    assert reply.json()["outputs"] == [{"name": "action", "datatype": "FP32", "shape": [1, 2], "data": [0.5, -1]}]
    assert reply.headers["x-league-replica"] == "replica-1"
    assert LENGTH not in reply.headers


def test_without_an_id_the_response_has_none(client: TestClient) -> None:
    assert infer(client, {"inputs": [VECTOR]}).json().keys() == {"model_name", "model_version", "outputs"}


@pytest.mark.parametrize(
    ("overall", "own", "is_binary"),
    [(None, None, False), (True, None, True), (False, True, True), (True, False, False), (None, True, True)],
)
def test_the_setting_of_an_output_has_precedence(
    client: TestClient, overall: bool | None, own: bool | None, is_binary: bool
) -> None:
    output: dict[str, Any] = {"name": "action"} | ({} if own is None else {"parameters": {"binary_data": own}})
    body: dict[str, Any] = {"inputs": [VECTOR], "outputs": [output]}
    if overall is not None:
        body["parameters"] = {"binary_data_output": overall}
    reply = infer(client, body)
    length = reply.headers.get(LENGTH)
    assert (length is not None) == is_binary
    if length is not None:
        head, rest = reply.content[: int(length)], reply.content[int(length) :]
        assert json.loads(head)["outputs"] == [
            {"name": "action", "datatype": "FP32", "shape": [1, 2], "parameters": {"binary_data_size": 8}}
        ]
        assert rest == np.array([0.5, -1], "<f4").tobytes()
        assert reply.headers["content-type"] == "application/octet-stream"


def test_nested_data_is_in_row_major_order(client: TestClient) -> None:
    flat = infer(client, {"inputs": [VECTOR | {"shape": [2, 2], "data": [1, 2, 3, 4]}]})
    nested = infer(client, {"inputs": [VECTOR | {"shape": [2, 2], "data": [[1, 2], [3, 4]]}]})
    assert flat.json() == nested.json()
    assert flat.json()["outputs"][0]["data"] == [1, 2, 3, 4]


def test_a_tensor_can_start_at_any_offset(client: TestClient) -> None:
    tensor = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "parameters": {"binary_data_size": 8}}
    for padding in range(8):
        head = json.dumps({"inputs": [tensor]}).encode() + b" " * padding
        reply = infer(client, head + np.array([3, 4], "<f4").tobytes(), **{LENGTH: str(len(head))})
        assert reply.json()["outputs"][0]["data"] == [3, 4]


def test_integral_floats_are_integers_and_integers_are_floats(client: TestClient) -> None:
    reply = infer(
        client, {"inputs": [{"name": "observation", "datatype": "INT64", "shape": [2], "data": [1.0, 3]}]}, "choice"
    )
    assert reply.json()["outputs"][0]["data"] == [0, 2]


BAD_BODIES: dict[str, tuple[Any, str]] = {
    "empty": (b"", "it is empty"),
    "no JSON": (b"{'inputs': []}", "not JSON"),
    "a list": ([], "expected an object"),
    "no inputs": ({}, "inputs is null"),
    "inputs an object": ({"inputs": {}}, "inputs is an object"),
    "inputs of numbers": ({"inputs": [1]}, "list of objects"),
    "nothing in inputs": ({"inputs": []}, "input observation is missing"),
    "outputs a string": ({"inputs": [VECTOR], "outputs": "action"}, "outputs is a string"),
    "an output without name": ({"inputs": [VECTOR], "outputs": [{}]}, "the name of an output is null"),
    "an id of number": ({"id": 7, "inputs": [VECTOR]}, "the id of the request is a number"),
    "parameters a list": ({"inputs": [VECTOR], "parameters": []}, "parameters of the request are a list"),
    "binary_data a number": (
        {"inputs": [VECTOR], "outputs": [{"name": "action", "parameters": {"binary_data": 1}}]},
        "binary_data is a number",
    ),
    "no name": ({"inputs": [{"datatype": "FP32", "shape": [1, 2], "data": [1, 2]}]}, "the name of an input is null"),
    "no datatype": ({"inputs": [{"name": "observation", "shape": [1, 2], "data": [1, 2]}]}, "the datatype of an input"),
    "no shape": ({"inputs": [{"name": "observation", "datatype": "FP32", "data": [1, 2]}]}, "the shape of input"),
    "a shape of floats": ({"inputs": [VECTOR | {"shape": [1, 2.0]}]}, "not a list of integers"),
    "a shape of booleans": ({"inputs": [VECTOR | {"shape": [True, 2]}]}, "not a list of integers"),
    "a negative shape": ({"inputs": [VECTOR | {"shape": [-1, 2]}]}, "expected [batch, 2]"),
    "a huge shape": ({"inputs": [VECTOR | {"shape": [2**62, 2]}]}, "expected at most 8"),
    "no data": ({"inputs": [{"name": "observation", "datatype": "FP32", "shape": [1, 2]}]}, "neither binary_data_size"),
    "data a number": ({"inputs": [VECTOR | {"data": 3}]}, "neither binary_data_size"),
    "too little data": ({"inputs": [VECTOR | {"data": [1]}]}, "has 1 elements, expected 2"),
    "too much data": ({"inputs": [VECTOR | {"data": [1, 2, 3]}]}, "has 3 elements, expected 2"),
    "ragged data": ({"inputs": [VECTOR | {"data": [[1], 2]}]}, "unequal depth"),
    "strings": ({"inputs": [VECTOR | {"data": ["1", "2"]}]}, "values other than FP32"),
    "long strings": ({"inputs": [VECTOR | {"data": ["x" * 20_000, ""]}]}, "values other than FP32"),
    "null": ({"inputs": [VECTOR | {"data": [1, None]}]}, "values other than FP32"),
    "booleans": ({"inputs": [VECTOR | {"data": [True, False]}]}, "values other than FP32"),
    "objects": ({"inputs": [VECTOR | {"data": [{}, {}]}]}, "values other than FP32"),
    "deep": (b'{"inputs": [{"data": ' + b"[" * 10_000 + b"]" * 10_000 + b"}]}", "not JSON"),
    "less deep": ({"inputs": [VECTOR | {"data": json.loads("[" * 500 + "]" * 500)}]}, "has 0 elements"),
    "overflow": (
        b'{"inputs": [{"name": "observation", "datatype": "FP32", "shape": [1, 2], "data": [1e99, 0]}]}',
        "finite",
    ),
    "twice": ({"inputs": [VECTOR, VECTOR]}, "given twice"),
    "binary without bytes": (
        {
            "inputs": [
                {"name": "observation", "datatype": "FP32", "shape": [1, 2], "parameters": {"binary_data_size": 8}}
            ]
        },
        "the inputs declare 8",
    ),
    "both": ({"inputs": [VECTOR | {"parameters": {"binary_data_size": 8}}]}, "and data must be absent"),
    "a negative size": ({"inputs": [VECTOR | {"parameters": {"binary_data_size": -8}}]}, "must be a number of bytes"),
}


@pytest.mark.parametrize("name", BAD_BODIES)
def test_an_invalid_body_is_rejected(client: TestClient, name: str) -> None:
    body, message = BAD_BODIES[name]
    reply = infer(client, body)
    assert message in error_of(reply, 413 if "at most" in message else 400)


@pytest.mark.parametrize(
    ("datatype", "data", "message"),
    [
        ("INT64", [0.5], "fractions"),
        ("INT64", [2**63], "out of range for INT64"),
        ("INT64", [1e300], "must be between"),
        ("INT64", [-1], "between 0 and 3"),
    ],
)
def test_integers_are_integral_and_in_range(client: TestClient, datatype: str, data: list[Any], message: str) -> None:
    tensor = {"name": "observation", "datatype": datatype, "shape": [1], "data": data}
    assert message in error_of(infer(client, {"inputs": [tensor]}, "choice"))


@pytest.mark.parametrize(
    ("length", "message"),
    [
        ("x", "number of bytes"),
        ("-1", "number of bytes"),
        ("9" * 30, "number of bytes"),
        ("0", "empty"),
        ("99999", "the body has"),
    ],
)
def test_an_invalid_header_length_is_rejected(client: TestClient, length: str, message: str) -> None:
    assert message in error_of(infer(client, {"inputs": [VECTOR]}, **{LENGTH: length}))


def test_bytes_of_a_boolean_are_0_and_1(client: TestClient) -> None:
    planes = {"name": "observation", "datatype": "BOOL", "shape": [1, 8, 8, 111]}
    mask = {"name": "action_mask", "datatype": "INT8", "shape": [1, 4672], "data": [1] * 4672}
    head = json.dumps({"inputs": [planes | {"parameters": {"binary_data_size": 7104}}, mask]}).encode()
    reply = infer(client, head + b"\x02" * 7104, "chess", **{LENGTH: str(len(head))})
    assert "bytes other than 0 and 1" in error_of(reply)
    numbers = {"inputs": [planes | {"data": [1] * 7104}, mask]}
    assert "values other than BOOL" in error_of(infer(client, numbers, "chess"))


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", "/v2/models/nobody", 404),
        ("GET", "/v2/models/board/versions/99", 404),
        ("GET", "/v2/models/board/versions/rival/config", 404),
        ("GET", "/v2/models/board/versions/99/stats", 404),
        ("GET", "/v2/models/Board/ready", 400),
        ("GET", "/v2/models/empty/ready", 503),
        ("GET", "/v2/models/board/versions/0/ready", 400),
        ("GET", "/v2/nothing", 404),
        ("GET", "/v2/models/board/infer", 405),
        ("POST", "/v2/models/board", 405),
        ("POST", "/v2/repository/models/board/load", 404),
        ("GET", "/v2/repository/index", 405),
    ],
)
def test_errors_have_the_format_of_the_protocol(client: TestClient, method: str, path: str, status: int) -> None:
    reply = client.request(method, path)
    error_of(reply, status)
    assert ("retry-after" in reply.headers) == (status == 503)


def test_the_index_can_be_limited_to_loaded_models(client: TestClient) -> None:
    index = client.post("/v2/repository/index").json()
    ready = client.post("/v2/repository/index", json={"ready": True}).json()
    assert {model["state"] for model in ready} == {"READY"}
    assert [model for model in index if model["state"] == "READY"] == ready
    assert {"name": "board", "version": "1", "state": "READY"} in ready
    error_of(client.post("/v2/repository/index", json={"ready": 1}))
    error_of(client.post("/v2/repository/index", content=b"["))


def test_an_optional_field_may_be_null(client: TestClient) -> None:
    """Serialisers of Java and C# write fields without a value."""
    unset = {"sequence_id": None, "binary_data_output": None, "classification": None}
    tensor = VECTOR | {"parameters": {"binary_data_size": None, "shared_memory_region": None}}
    output = {"name": "action", "datatype": None, "shape": None, "data": None, "parameters": {"binary_data": None}}
    expected = infer(client, {"inputs": [VECTOR]}).json()
    for body in (
        {"id": None, "parameters": None, "outputs": None, "inputs": [VECTOR | {"parameters": None}]},
        {"id": None, "parameters": unset, "outputs": [output, {"name": "action_dist_inputs"}], "inputs": [tensor]},
    ):
        reply = infer(client, body)
        assert (reply.status_code, reply.json()) == (200, expected)
    assert client.post("/v2/repository/index", json={"ready": None, "name": None}).status_code == 200
    assert "the id of the request is a number" in error_of(infer(client, {"id": 1, "inputs": [VECTOR]}))


@pytest.mark.parametrize(
    ("encoding", "compress"),
    [("gzip", gzip.compress), ("x-gzip", gzip.compress), ("deflate", zlib.compress), ("identity", bytes)],
)
def test_a_compressed_body_is_accepted(client: TestClient, encoding: str, compress: Any) -> None:
    tensor = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "parameters": {"binary_data_size": 8}}
    head = json.dumps({"inputs": [tensor]}).encode()
    body = compress(head + np.array([3, 4], "<f4").tobytes())
    reply = infer(client, body, **{LENGTH: str(len(head)), "Content-Encoding": encoding})
    assert reply.json()["outputs"][0]["data"] == [3, 4]


@pytest.mark.parametrize(
    ("encoding", "body", "status"),
    [
        ("gzip", b"no gzip", 400),
        ("gzip", gzip.compress(b"{}", mtime=0)[:-4], 400),
        ("gzip", gzip.compress(b"{}", mtime=0) + b"more", 400),
        ("deflate", gzip.compress(b"{}", mtime=0), 400),
        ("br", b"{}", 415),
        ("gzip, gzip", gzip.compress(gzip.compress(b"{}", mtime=0), mtime=0), 415),
        ("gzip", gzip.compress(b" " * (SETTINGS.max_body + 1), mtime=0), 413),
        ("deflate", zlib.compress(b" " * 100 * 2**20), 413),
    ],
)
def test_a_body_that_cannot_be_decompressed_is_rejected(
    client: TestClient, encoding: str, body: bytes, status: int
) -> None:
    error_of(infer(client, body, **{"Content-Encoding": encoding}), status)


@pytest.mark.parametrize(
    ("accepted", "encoding"),
    [
        ("gzip", "gzip"),
        ("deflate", "deflate"),
        ("br, gzip;q=0.8", "gzip"),
        ("gzip;q=0", None),
        ("br", None),
        ("", None),
    ],
)
def test_a_large_response_is_compressed_if_accepted(client: TestClient, accepted: str, encoding: str | None) -> None:
    body = {
        "inputs": [
            {"name": "observation", "datatype": "BOOL", "shape": [1, 8, 8, 111], "data": [False] * 7104},
            {"name": "action_mask", "datatype": "INT8", "shape": [1, 4672], "data": [1] * 4672},
        ]
    }
    reply = infer(client, body, "chess", **{"Accept-Encoding": accepted})
    assert reply.headers.get("content-encoding") == encoding
    assert len(reply.json()["outputs"][1]["data"]) == 4672
    small = infer(client, {"inputs": [VECTOR]}, **{"Accept-Encoding": accepted})
    assert "content-encoding" not in small.headers


def test_a_large_body_is_rejected(client: TestClient) -> None:
    assert "larger than" in error_of(infer(client, b" " * (SETTINGS.max_body + 1)), 413)
    in_parts = (b" " * 2**16 for _ in range(SETTINGS.max_body // 2**16 + 1))
    assert "larger than" in error_of(client.post("/v2/models/vector/infer", content=in_parts), 413)


def test_metadata_without_a_database_lists_the_loaded_versions(
    leagues: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    with application(leagues, SETTINGS) as client:

        def fail(*_: object) -> None:
            raise StorageError("the database is gone")

        monkeypatch.setattr(VersionRepository, "numbers", fail)
        assert client.get("/v2/models/board").json()["versions"] == ["1"]
        assert infer(client, {"inputs": [VECTOR]}).status_code == 200
        assert "see the server log" in error_of(client.post("/v2/repository/index"), 503)


def test_a_promotion_is_followed(tmp_path_factory: pytest.TempPathFactory) -> None:
    registry = everything(Storage.at(tmp_path_factory.mktemp("promoted")))
    with application(registry.storage, QUICK) as client:

        def is_served(version: str) -> bool:
            return client.get("/v2/models/board/stats").json()["model_stats"][-1]["version"] == version

        for version in ("2", "3", "1"):
            promote(registry, "board", int(version))
            until(partial(is_served, version))
    registry.close()


tensors = st.fixed_dictionaries(
    {},
    optional={
        "name": st.sampled_from(["observation", "action_mask", "state_in_0"]) | st.text(max_size=5),
        "datatype": st.sampled_from(["FP32", "INT8", "BOOL", "BYTES", "INT64"]) | st.text(max_size=5),
        "shape": st.lists(st.integers(-1, 3) | st.just(2**63), max_size=4) | st.text(max_size=3),
        "data": st.lists(st.floats() | st.integers() | st.booleans() | st.text(max_size=3), max_size=8),
        "parameters": st.fixed_dictionaries(
            {}, optional={"binary_data_size": st.integers(-1, 80) | st.text(max_size=2)}
        ),
    },
)
documents = st.fixed_dictionaries(
    {},
    optional={
        "id": st.text(max_size=5) | st.integers(),
        "inputs": st.lists(tensors, max_size=4) | st.text(max_size=3),
        "outputs": st.lists(
            st.fixed_dictionaries(
                {},
                optional={
                    "name": st.sampled_from(["action", "action_dist_inputs"]) | st.text(max_size=5),
                    "parameters": st.dictionaries(st.just("binary_data"), st.booleans() | st.none()),
                },
            ),
            max_size=3,
        ),
        "parameters": st.dictionaries(
            st.sampled_from(["binary_data_output", "sequence_id", "timeout"]), st.booleans() | st.integers()
        ),
    },
)
VALID = {
    "inputs": [
        {"name": "observation", "datatype": "INT8", "shape": [1, 6, 7, 2], "parameters": {"binary_data_size": 84}},
        {"name": "action_mask", "datatype": "INT8", "shape": [1, 7], "parameters": {"binary_data_size": 7}},
    ]
}


@examples(400)
@given(
    document=documents | st.just(VALID),
    rest=st.binary(max_size=100) | st.just(bytes(84) + b"\1" * 7),
    shift=st.just(0) | st.integers(-40, 40),
    encoding=st.sampled_from(["identity", "identity", "gzip", "deflate", "br"]),
    accept=st.sampled_from(["gzip", "deflate;q=0", "*", ";;,=", ""]),
    model=st.sampled_from(["board", "vector", "nested", "memory", "duo", "duo.left", "chess"]),
    version=st.sampled_from(["1", "champion", "99", "0", "x y"]),
)
def test_no_request_causes_a_server_error(
    client: TestClient,
    document: Any,
    rest: bytes,
    shift: int,
    encoding: str,
    accept: str,
    model: str,
    version: str,
) -> None:
    head = json.dumps(document, allow_nan=True).encode()
    body = head + rest
    compressed_body = {"gzip": gzip.compress, "deflate": zlib.compress}.get(encoding, bytes)(body)
    headers = {LENGTH: str(len(head) + shift), "Content-Encoding": encoding, "Accept-Encoding": accept}
    reply = client.post(f"/v2/models/{model}/versions/{version}/infer", content=compressed_body, headers=headers)
    assert reply.status_code < 500
    if reply.status_code != 200:
        error_of(reply, reply.status_code)


@examples(200)
@given(body=st.binary(max_size=200), length=st.none() | st.integers(0, 220))
def test_no_body_causes_a_server_error(client: TestClient, body: bytes, length: int | None) -> None:
    reply = infer(client, body, **({} if length is None else {LENGTH: str(length)}))
    error_of(reply, reply.status_code)
    assert reply.status_code == 400
