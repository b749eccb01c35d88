"""REST without a client library: exact documents of the protocol, invalid bodies, and what statistics count."""

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import fields
from typing import Any

import httpx
import numpy as np
import pytest
from starlette.testclient import TestClient

from league.errors import StorageError
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow
from league.registry.versions import VersionRepository
from league.settings import Storage
from serve_app.app import Replica
from serve_app.inference_protocol.statistics import MAX_ENTRIES, Statistics, sum_documents
from tests.support.clients.actions import inference
from tests.support.servers.protocol_servers import SETTINGS
from tests.support.servers.replicas import READ_ONLY, local_client

LENGTH = "Inference-Header-Content-Length"
VECTOR = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "data": [0.5, -1]}


BINARY = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "parameters": {"binary_data_size": 8}}


METADATA = {
    "name": "board",
    "versions": ["1", "2", "3"],
    "platform": "onnxruntime_onnx",
    "inputs": [
        {"name": "observation", "datatype": "INT8", "shape": [-1, 6, 7, 2]},
        {"name": "action_mask", "datatype": "INT8", "shape": [-1, 7]},
    ],
    "outputs": [
        {"name": "action", "datatype": "INT64", "shape": [-1]},
        {"name": "action_dist_inputs", "datatype": "FP32", "shape": [-1, 7]},
    ],
}
DOCUMENTS: dict[str, dict[str, Any]] = {
    "/v2/health/live": {"live": True},
    "/v2/health/ready": {"ready": True},
    "/v2/models/board/ready": {"name": "board", "ready": True},
    "/v2/models/board/versions/2/ready": {"name": "board", "ready": True},
    **{f"/v2/models/board{version}": METADATA for version in ("", "/versions/champion", "/versions/2")},
}
STATISTICS = ("name", "version", "last_inference", "inference_count", "execution_count", "inference_stats")
CHESS = [
    {"name": "observation", "datatype": "BOOL", "shape": [1, 8, 8, 111], "data": [False] * 7104},
    {"name": "action_mask", "datatype": "INT8", "shape": [1, 4672], "data": [1] * 4672},
]


@pytest.fixture(scope="module")
def client(leagues: Storage) -> Iterator[TestClient]:
    # Another name: a replica that ends is removed from the registry, with its statistics.
    with local_client(Replica(Registry.open(leagues), SETTINGS, "rest")) as client:
        yield client


def infer(client: TestClient, body: Any, model: str = "vector", **headers: str) -> httpx.Response:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return client.post(f"/v2/models/{model}/infer", content=content, headers=headers)


def error_of(reply: httpx.Response, status: int = 400) -> str:
    assert reply.status_code == status, reply.text
    assert reply.json().keys() == {"error"}
    return str(reply.json()["error"])


def test_documents_are_those_of_the_protocol(client: TestClient) -> None:
    for path, document in DOCUMENTS.items():
        reply = client.get(path)
        assert (reply.status_code, reply.json()) == (200, document), path
    assert client.get("/v2").json().keys() == {"name", "version", "extensions"}
    assert infer(client, {"inputs": [VECTOR]}).json().keys() == {"model_name", "model_version", "outputs"}
    for path in ("/v2/models/stats", "/v2/models/board/stats", "/v2/models/board/versions/3/stats"):
        assert {tuple(entry) for entry in client.get(path).json()["model_stats"]} == {STATISTICS}
    reply = infer(client, {"id": "tick", "inputs": [VECTOR], "outputs": [{"name": "action"}]})
    action = {"name": "action", "datatype": "FP32", "shape": [1, 2], "data": [0.5, -1]}
    assert reply.json() == {"model_name": "vector", "model_version": "1", "id": "tick", "outputs": [action]}
    assert reply.headers["x-league-replica"] == "rest"
    assert LENGTH not in reply.headers


def test_the_setting_of_an_output_has_precedence(client: TestClient) -> None:
    for overall, of_output, is_binary in (
        (None, None, False),
        (True, None, True),
        (False, True, True),
        (True, False, False),
        (None, True, True),
    ):
        output = {"name": "action"} | ({} if of_output is None else {"parameters": {"binary_data": of_output}})
        parameters = {} if overall is None else {"parameters": {"binary_data_output": overall}}
        reply = infer(client, {"inputs": [VECTOR], "outputs": [output]} | parameters)
        length = reply.headers.get(LENGTH)
        assert (length is not None) == is_binary
        if length is not None:
            head, binary = reply.content[: int(length)], reply.content[int(length) :]
            tensor = {"name": "action", "datatype": "FP32", "shape": [1, 2], "parameters": {"binary_data_size": 8}}
            assert json.loads(head)["outputs"] == [tensor]
            assert binary == np.array([0.5, -1], "<f4").tobytes()
            assert reply.headers["content-type"] == "application/octet-stream"


def test_nested_data_is_in_row_major_order_and_integral_floats_are_integers(client: TestClient) -> None:
    for data in ([1, 2, 3, 4], [[1, 2], [3, 4]]):
        reply = infer(client, {"inputs": [VECTOR | {"shape": [2, 2], "data": data}]})
        assert reply.json()["outputs"][0]["data"] == [1, 2, 3, 4]
    reply = infer(client, {"inputs": [VECTOR | {"datatype": "INT64", "shape": [2], "data": [1.0, 3]}]}, "choice")
    assert reply.json()["outputs"][0]["data"] == [0, 2]


def test_a_tensor_can_start_at_any_offset(client: TestClient) -> None:
    for padding in range(8):
        head = json.dumps({"inputs": [BINARY]}).encode() + b" " * padding
        reply = infer(client, head + np.array([3, 4], "<f4").tobytes(), **{LENGTH: str(len(head))})
        assert reply.json()["outputs"][0]["data"] == [3, 4]


OUTPUT = {"name": "action", "parameters": {"binary_data": 1}}


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
    "binary_data a number": ({"inputs": [VECTOR], "outputs": [OUTPUT]}, "binary_data is a number"),
    "no name": ({"inputs": [VECTOR | {"name": None}]}, "the name of an input is null"),
    "no datatype": ({"inputs": [VECTOR | {"datatype": None}]}, "the datatype of an input"),
    "no shape": ({"inputs": [VECTOR | {"shape": None}]}, "the shape of input"),
    "a shape of floats": ({"inputs": [VECTOR | {"shape": [1, 2.0]}]}, "not a list of integers"),
    "a shape of booleans": ({"inputs": [VECTOR | {"shape": [True, 2]}]}, "not a list of integers"),
    "a negative shape": ({"inputs": [VECTOR | {"shape": [-1, 2]}]}, "expected [batch, 2]"),
    "a huge shape": ({"inputs": [VECTOR | {"shape": [2**62, 2]}]}, "expected at most 8"),
    "no data": ({"inputs": [VECTOR | {"data": None}]}, "neither binary_data_size"),
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
    "overflow": ({"inputs": [VECTOR | {"data": [1e99, 0]}]}, "finite"),
    "twice": ({"inputs": [VECTOR, VECTOR]}, "given twice"),
    "binary without bytes": ({"inputs": [BINARY]}, "the inputs declare 8"),
    "both": ({"inputs": [VECTOR | {"parameters": {"binary_data_size": 8}}]}, "and data must be absent"),
    "a negative size": ({"inputs": [VECTOR | {"parameters": {"binary_data_size": -8}}]}, "must be a number of bytes"),
}


def test_an_invalid_body_is_rejected(client: TestClient, subtests: pytest.Subtests) -> None:
    for name, (body, message) in BAD_BODIES.items():
        with subtests.test(name):
            assert message in error_of(infer(client, body), 413 if "at most" in message else 400)
    for number, message in ((0.5, "fractions"), (2**63, "out of range"), (1e300, "must be between"), (-1, "0 and 3")):
        with subtests.test(number=number):
            tensor = {"name": "observation", "datatype": "INT64", "shape": [1], "data": [number]}
            assert message in error_of(infer(client, {"inputs": [tensor]}, "choice"))
    of_length = (("x", "number of bytes"), ("-1", "number of bytes"), ("9" * 30, "number of bytes"), ("0", "empty"))
    for length, message in (*of_length, ("99999", "the body has")):
        with subtests.test(length=length):
            assert message in error_of(infer(client, {"inputs": [VECTOR]}, **{LENGTH: length}))
    planes, mask = CHESS
    numbers = {"inputs": [planes | {"data": [1] * 7104}, mask]}
    assert "values other than BOOL" in error_of(infer(client, numbers, "chess"))
    planes = {name: planes[name] for name in planes.keys() - {"data"}} | {"parameters": {"binary_data_size": 7104}}
    head = json.dumps({"inputs": [planes, mask]}).encode()
    reply = infer(client, head + b"\x02" * 7104, "chess", **{LENGTH: str(len(head))})
    assert "bytes other than 0 and 1" in error_of(reply)


def test_errors_have_the_format_of_the_protocol(client: TestClient, subtests: pytest.Subtests) -> None:
    for method, path, status in (
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
    ):
        with subtests.test(path):
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


def test_metadata_without_a_database_lists_the_loaded_versions(
    leagues: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    with local_client(Replica(Registry.open(leagues), SETTINGS, "alone")) as client:

        def fail(*_: object) -> None:
            raise StorageError("the database is gone")

        monkeypatch.setattr(VersionRepository, "numbers", fail)
        assert client.get("/v2/models/board").json()["versions"] == ["1"]
        assert infer(client, {"inputs": [VECTOR]}).status_code == 200
        assert "see the server log" in error_of(client.post("/v2/repository/index"), 503)


def test_durations_are_of_the_parts_of_a_request() -> None:
    entry = Statistics().entry("board", 1)
    entry.succeed(3, begun=0, found=1, read=10, ran=100, done=1000)
    entry.succeed(2, begun=0, found=0, read=1, ran=2, done=3, executions=0)
    entry.fail(50)
    document = entry.document
    assert (document["inference_count"], document["execution_count"]) == (5, 1)
    assert document["inference_stats"] == {
        "success": {"count": 2, "ns": 1003},
        "fail": {"count": 1, "ns": 50},
        "queue": {"count": 2, "ns": 1},
        "compute_input": {"count": 2, "ns": 10},
        "compute_infer": {"count": 2, "ns": 91},
        "compute_output": {"count": 2, "ns": 901},
        "cache_hit": {"count": 0, "ns": 0},
        "cache_miss": {"count": 0, "ns": 0},
    }


def test_the_least_recently_used_entry_is_evicted() -> None:
    statistics = Statistics()
    for version in range(1, MAX_ENTRIES + 1):
        statistics.entry("board", version)
    statistics.entry("board", 1).fail(1)
    statistics.entry("board", MAX_ENTRIES + 1)
    kept = statistics.documents()
    assert len(kept) == MAX_ENTRIES
    assert [document["version"] for document in kept[:2]] == ["1", "3"]


def test_statistics_of_replicas_are_summed_by_model_and_version() -> None:
    replicas = [Statistics(), Statistics()]
    for number, statistics in enumerate(replicas, 1):
        statistics.entry("board", 1).succeed(number, begun=0, found=0, read=1, ran=3, done=6)
    replicas[1].entry("board", 2).fail(5)
    first, second = sum_documents([document for statistics in replicas for document in statistics.documents()])
    assert (first["version"], first["inference_count"], first["execution_count"]) == ("1", 3, 2)
    assert first["inference_stats"]["success"] == {"count": 2, "ns": 12}
    assert first["last_inference"] == max(statistics.documents()[0]["last_inference"] for statistics in replicas)
    assert (second["version"], second["inference_stats"]["fail"]["count"]) == ("2", 1)


RARELY = READ_ONLY.model_copy(update={"heartbeat": 5.0})


REQUEST = inference({"observation": np.zeros((1, 2), np.float32)})


def count(replica: TestClient) -> int:
    (entry,) = replica.get("/v2/models/vector/versions/1/stats").json()["model_stats"]
    return int(entry["inference_stats"]["success"]["count"])


def test_a_league_of_another_release_is_left_out_of_the_index(registry: Registry) -> None:
    with local_client(Replica(Registry.open(registry.storage), RARELY, "catalogue-3")) as replica:
        before = replica.post("/v2/repository/index").json()
        for name, interface in (("configured", {}), ("described", {"interface_document": {"of": "another release"}})):
            with registry.database.write() as session:
                row = session.get_one(LeagueRow, "board")
                values = {field.name: getattr(row, field.name) for field in fields(row)}
                values |= {"slug": name, "config_document": {"of": "another release"}}
                session.add(LeagueRow(**values | interface))
        assert replica.post("/v2/repository/index").json() == before
        assert registry.leagues.action_selections().keys() >= {"board", "configured", "described"}, "replicas go on"


def test_counts_never_decrease_from_one_replica_to_the_next(registry: Registry) -> None:
    with ExitStack() as running:
        one, other = (
            running.enter_context(local_client(Replica(Registry.open(registry.storage), RARELY, name)))
            for name in ("catalogue-1", "catalogue-2")
        )
        before = count(other)
        for asked in (one, other, other, one, one):
            assert asked.post("/v2/models/vector/infer", json=REQUEST).status_code == 200
            counts = [count(asked), count(one), count(other)]
            before += 1
            assert counts == [before] * 3
