"""REST without a client library: the protocol's documents to the letter, and every way to get a body wrong."""

import asyncio
import gzip
import json
import zlib
from collections.abc import AsyncIterator, Iterator
from typing import Any

import httpx
import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient

from league.errors import StorageError
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Server
from tests.serve_app.conftest import replica as application
from tests.serve_app.inference_protocol.conftest import SETTINGS
from tests.serve_app.leagues import everything, promote

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


def closed(**properties: Any) -> dict[str, Any]:
    """The schema of an object with these properties, no other, and none left out."""
    return {"type": "object", "properties": properties, "required": list(properties), "additionalProperties": False}


SCHEMAS: dict[str, dict[str, Any]] = {
    "/v2": closed(name=NAME, version=NAME, extensions={"type": "array", "items": NAME}),
    "/v2/health/live": closed(live={"const": True}),
    "/v2/health/ready": closed(ready={"const": True}),
    "/v2/models/board/ready": closed(name={"const": "board"}, ready={"const": True}),
    "/v2/models/board": closed(
        name={"const": "board"},
        versions={"type": "array", "items": NAME},
        platform={"const": "onnxruntime_onnx"},
        inputs=TENSORS,
        outputs=TENSORS,
    ),
    "/v2/models/stats": closed(
        model_stats={
            "type": "array",
            "items": closed(
                name=NAME,
                version=NAME,
                last_inference={"type": "integer"},
                inference_count={"type": "integer"},
                execution_count={"type": "integer"},
                inference_stats=closed(**dict.fromkeys(DURATIONS, DURATION)),
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
REPLY = closed(
    model_name={"const": "vector"},
    model_version={"const": "1"},
    id={"const": "tick"},
    outputs={
        "type": "array",
        "items": closed(
            name=NAME,
            datatype=NAME,
            shape={"type": "array", "items": {"type": "integer"}},
            data={"type": "array", "items": {"type": "number"}},
        ),
    },
)
ERROR = closed(error={"type": "string", "minLength": 1})


@pytest.fixture(scope="module")
def client(leagues: Storage) -> Iterator[TestClient]:
    with application(leagues, SETTINGS) as client:
        yield client


def infer(client: TestClient, body: Any, model: str = "vector", **headers: str) -> httpx.Response:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return client.post(f"/v2/models/{model}/infer", content=content, headers=headers)


def refused(reply: httpx.Response, status: int = 400) -> str:
    assert reply.status_code == status, reply.text
    jsonschema.validate(reply.json(), ERROR)
    return str(reply.json()["error"])


@pytest.mark.parametrize("path", SCHEMAS)
def test_documents_are_the_protocol_s(client: TestClient, path: str) -> None:
    assert infer(client, {"inputs": [VECTOR]}).status_code == 200
    reply = client.get(path)
    assert reply.status_code == 200
    jsonschema.validate(reply.json(), SCHEMAS[path])


def test_an_inference_is_answered_as_the_protocol_has_it(client: TestClient) -> None:
    reply = infer(client, {"id": "tick", "inputs": [VECTOR], "outputs": [{"name": "action"}]})
    jsonschema.validate(reply.json(), REPLY)
    assert reply.json()["outputs"] == [{"name": "action", "datatype": "FP32", "shape": [1, 2], "data": [0.5, -1]}]
    assert reply.headers["x-league-replica"] == "replica-1"
    assert LENGTH not in reply.headers


def test_no_id_gets_none_back(client: TestClient) -> None:
    assert infer(client, {"inputs": [VECTOR]}).json().keys() == {"model_name", "model_version", "outputs"}


@pytest.mark.parametrize(
    ("overall", "own", "is_binary"),
    [(None, None, False), (True, None, True), (False, True, True), (True, False, False), (None, True, True)],
)
def test_an_output_s_own_wish_goes_first(
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


def test_nested_data_counts_in_row_major_order(client: TestClient) -> None:
    flat = infer(client, {"inputs": [VECTOR | {"shape": [2, 2], "data": [1, 2, 3, 4]}]})
    nested = infer(client, {"inputs": [VECTOR | {"shape": [2, 2], "data": [[1, 2], [3, 4]]}]})
    assert flat.json() == nested.json()
    assert flat.json()["outputs"][0]["data"] == [1, 2, 3, 4]


def test_a_tensor_may_begin_anywhere_in_the_body(client: TestClient) -> None:
    tensor = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "parameters": {"binary_data_size": 8}}
    for padding in range(8):
        head = json.dumps({"inputs": [tensor]}).encode() + b" " * padding
        reply = infer(client, head + np.array([3, 4], "<f4").tobytes(), **{LENGTH: str(len(head))})
        assert reply.json()["outputs"][0]["data"] == [3, 4]


def test_whole_floats_are_integers_and_integers_are_floats(client: TestClient) -> None:
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
    "strings": ({"inputs": [VECTOR | {"data": ["1", "2"]}]}, "something other than FP32"),
    "long strings": ({"inputs": [VECTOR | {"data": ["x" * 20_000] + [""] * 10_000}]}, "something other than FP32"),
    "null": ({"inputs": [VECTOR | {"data": [1, None]}]}, "something other than FP32"),
    "booleans": ({"inputs": [VECTOR | {"data": [True, False]}]}, "something other than FP32"),
    "objects": ({"inputs": [VECTOR | {"data": [{}, {}]}]}, "something other than FP32"),
    "deep": (b'{"inputs": [{"data": ' + b"[" * 20_000 + b"]" * 20_000 + b"}]}", "not JSON"),
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
        "the inputs name 8",
    ),
    "both": ({"inputs": [VECTOR | {"parameters": {"binary_data_size": 8}}]}, "without data beside it"),
    "a negative size": ({"inputs": [VECTOR | {"parameters": {"binary_data_size": -8}}]}, "must be a number of bytes"),
}


@pytest.mark.parametrize("name", BAD_BODIES)
def test_a_bad_body_is_refused_in_a_sentence(client: TestClient, name: str) -> None:
    body, words = BAD_BODIES[name]
    reply = infer(client, body)
    assert words in refused(reply, 413 if "at most" in words else 400)


@pytest.mark.parametrize(
    ("datatype", "data", "words"),
    [
        ("INT64", [0.5], "fractions"),
        ("INT64", [2**63], "does not fit INT64"),
        ("INT64", [1e300], "must be between"),
        ("INT64", [-1], "between 0 and 3"),
    ],
)
def test_integers_are_whole_and_fit(client: TestClient, datatype: str, data: list[Any], words: str) -> None:
    tensor = {"name": "observation", "datatype": datatype, "shape": [1], "data": data}
    assert words in refused(infer(client, {"inputs": [tensor]}, "choice"))


@pytest.mark.parametrize(
    ("length", "words"),
    [
        ("x", "number of bytes"),
        ("-1", "number of bytes"),
        ("9" * 30, "number of bytes"),
        ("0", "empty"),
        ("99999", "the body has"),
    ],
)
def test_a_header_length_that_is_none(client: TestClient, length: str, words: str) -> None:
    assert words in refused(infer(client, {"inputs": [VECTOR]}, **{LENGTH: length}))


def test_bytes_of_a_boolean_are_0_and_1(client: TestClient) -> None:
    planes = {"name": "observation", "datatype": "BOOL", "shape": [1, 8, 8, 111]}
    mask = {"name": "action_mask", "datatype": "INT8", "shape": [1, 4672], "data": [1] * 4672}
    head = json.dumps({"inputs": [planes | {"parameters": {"binary_data_size": 7104}}, mask]}).encode()
    reply = infer(client, head + b"\x02" * 7104, "chess", **{LENGTH: str(len(head))})
    assert "bytes other than 0 and 1" in refused(reply)
    numbers = {"inputs": [planes | {"data": [1] * 7104}, mask]}
    assert "something other than BOOL" in refused(infer(client, numbers, "chess"))


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
def test_errors_have_the_protocol_s_form(client: TestClient, method: str, path: str, status: int) -> None:
    reply = client.request(method, path)
    refused(reply, status)
    assert ("retry-after" in reply.headers) == (status == 503)


def test_the_index_can_be_of_what_is_in_memory(client: TestClient) -> None:
    index = client.post("/v2/repository/index").json()
    ready = client.post("/v2/repository/index", json={"ready": True}).json()
    assert {model["state"] for model in ready} == {"READY"}
    assert [model for model in index if model["state"] == "READY"] == ready
    assert {"name": "board", "version": "1", "state": "READY"} in ready
    refused(client.post("/v2/repository/index", json={"ready": 1}))
    refused(client.post("/v2/repository/index", content=b"["))


@pytest.mark.parametrize(
    ("encoding", "compress"),
    [("gzip", gzip.compress), ("x-gzip", gzip.compress), ("deflate", zlib.compress), ("identity", bytes)],
)
def test_a_compressed_body(client: TestClient, encoding: str, compress: Any) -> None:
    tensor = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "parameters": {"binary_data_size": 8}}
    head = json.dumps({"inputs": [tensor]}).encode()
    body = compress(head + np.array([3, 4], "<f4").tobytes())
    reply = infer(client, body, **{LENGTH: str(len(head)), "Content-Encoding": encoding})
    assert reply.json()["outputs"][0]["data"] == [3, 4]


@pytest.mark.parametrize(
    ("encoding", "body", "status"),
    [
        ("gzip", b"no gzip", 400),
        ("gzip", gzip.compress(b"{}")[:-4], 400),
        ("gzip", gzip.compress(b"{}") + b"more", 400),
        ("deflate", gzip.compress(b"{}"), 400),
        ("br", b"{}", 415),
        ("gzip, gzip", gzip.compress(gzip.compress(b"{}")), 415),
        ("gzip", gzip.compress(b" " * (SETTINGS.max_body + 1)), 413),
        ("deflate", zlib.compress(b" " * 100 * 2**20), 413),
    ],
)
def test_a_body_that_cannot_be_decompressed(client: TestClient, encoding: str, body: bytes, status: int) -> None:
    refused(infer(client, body, **{"Content-Encoding": encoding}), status)


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
def test_a_large_reply_is_compressed_if_that_is_accepted(
    client: TestClient, accepted: str, encoding: str | None
) -> None:
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


def test_a_large_body_is_refused(client: TestClient) -> None:
    assert "larger than" in refused(infer(client, b" " * (SETTINGS.max_body + 1)), 413)
    in_parts = (b" " * 2**16 for _ in range(SETTINGS.max_body // 2**16 + 1))
    assert "larger than" in refused(client.post("/v2/models/vector/infer", content=in_parts), 413)


@pytest.mark.anyio
async def test_too_many_requests_at_once_are_told_to_come_back(leagues: Storage) -> None:
    server = Server(Registry.open(leagues), SETTINGS.model_copy(update={"max_in_flight": 2}), "replica-1")
    body_comes = asyncio.Event()

    async def body() -> AsyncIterator[bytes]:
        await body_comes.wait()
        yield json.dumps({"inputs": [VECTOR]}).encode()

    path = "/v2/models/vector/infer"
    transport = httpx.ASGITransport(server.application())
    async with server.watcher.watching(), httpx.AsyncClient(transport=transport, base_url="http://replica") as client:
        slow = [asyncio.create_task(client.post(path, content=body())) for _ in range(2)]
        while server.inference.in_flight < 2:
            await asyncio.sleep(0)
        reply = await client.post(path, json={"inputs": [VECTOR]})
        refused(reply, 429)
        assert reply.headers["retry-after"] == "1"
        body_comes.set()
        assert [(await each).status_code for each in slow] == [200, 200]
        assert (await client.post(path, json={"inputs": [VECTOR]})).status_code == 200


def test_metadata_without_a_database_names_what_answers(leagues: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    with application(leagues, SETTINGS) as client:

        def gone(*_: object) -> None:
            raise StorageError("the database is gone")

        monkeypatch.setattr(Registry, "version_numbers", gone)
        assert client.get("/v2/models/board").json()["versions"] == ["1"]
        assert infer(client, {"inputs": [VECTOR]}).status_code == 200
        assert "the database is gone" in refused(client.post("/v2/repository/index"), 503)


def test_a_promotion_is_followed(tmp_path_factory: pytest.TempPathFactory) -> None:
    registry = everything(Storage.at(tmp_path_factory.mktemp("promoted")))
    with application(registry.storage, SETTINGS) as client:
        for version in ("2", "3", "1"):
            promote(registry, "board", int(version))
            while client.get("/v2/models/board/stats").json()["model_stats"][-1]["version"] != version:
                pass
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


@settings(max_examples=400, deadline=None)
@given(
    document=documents | st.just(VALID),
    rest=st.binary(max_size=100) | st.just(bytes(84) + b"\1" * 7),
    shift=st.just(0) | st.integers(-40, 40),
    encoding=st.sampled_from(["identity", "identity", "gzip", "deflate", "br"]),
    accept=st.sampled_from(["gzip", "deflate;q=0", "*", ";;,=", ""]),
    model=st.sampled_from(["board", "vector", "nested", "memory", "duo", "duo.left", "chess"]),
    version=st.sampled_from(["1", "champion", "99", "0", "x y"]),
)
def test_no_frame_is_the_server_s_fault(
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
    packed = {"gzip": gzip.compress, "deflate": zlib.compress}.get(encoding, bytes)(body)
    headers = {LENGTH: str(len(head) + shift), "Content-Encoding": encoding, "Accept-Encoding": accept}
    reply = client.post(f"/v2/models/{model}/versions/{version}/infer", content=packed, headers=headers)
    assert reply.status_code < 500
    if reply.status_code != 200:
        refused(reply, reply.status_code)


@settings(max_examples=200, deadline=None)
@given(body=st.binary(max_size=200), length=st.none() | st.integers(0, 220))
def test_no_bytes_are_the_server_s_fault(client: TestClient, body: bytes, length: int | None) -> None:
    reply = infer(client, body, **({} if length is None else {LENGTH: str(length)}))
    refused(reply, reply.status_code)
    assert reply.status_code == 400
