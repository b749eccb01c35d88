"""The unmodified client of the protocol: HTTP and gRPC, synchronous and asyncio, with each tensor type."""

import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
from tritonclient.utils import InferenceServerException

from league.settings import Storage
from tests.support.clients.protocol_observations import observations, policy_of
from tests.support.clients.triton import FORMS, Triton, assert_same, outputs_of
from tests.support.servers.protocol_servers import Address

MODELS = ("board", "board.shared", "duo.left", "vector", "nested", "choice", "chess", "pistons", "kinds")
OUTPUTS = ("action", "action_dist_inputs")


@pytest.fixture(scope="module")
def clients(replica: Address) -> Iterator[dict[str, Triton]]:
    with ExitStack() as stack:
        yield {form: stack.enter_context(Triton(form, replica)) for form in FORMS}


@pytest.fixture(params=FORMS)
def triton(request: pytest.FixtureRequest, clients: dict[str, Triton]) -> Triton:
    return clients[request.param]


@pytest.fixture(params=["http", "http.aio"])
def over_http(request: pytest.FixtureRequest, clients: dict[str, Triton]) -> Triton:
    return clients[request.param]


@pytest.fixture(params=["grpc", "grpc.aio"])
def over_grpc(request: pytest.FixtureRequest, clients: dict[str, Triton]) -> Triton:
    return clients[request.param]


def error_of(triton: Triton, *arguments: Any, **options: Any) -> str:
    """The message with which an inference is rejected; fails on a server error."""
    with pytest.raises(InferenceServerException) as caught:
        triton.infer(*arguments, **options)
    assert not caught.value.status().startswith("5")
    assert "INTERNAL" not in caught.value.status()
    return str(caught.value.message())


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("rows", [1, 3])
@pytest.mark.parametrize("binary", [True, False], ids=["binary", "json"])
def test_each_tensor_type(triton: Triton, leagues: Storage, model: str, rows: int, binary: bool) -> None:
    policy, signature = policy_of(leagues, model)
    arrays = observations(signature, rows)
    expected = policy.distribution(arrays)
    assert expected.dist_inputs is not None
    result = triton.infer(model, arrays, outputs=OUTPUTS, binary=binary)
    assert_same(result.as_numpy("action"), expected.actions)
    assert_same(result.as_numpy("action_dist_inputs"), expected.dist_inputs)


@pytest.mark.parametrize(("version", "number"), [("", 1), ("1", 1), ("2", 2), ("3", 3), ("champion", 1)])
def test_a_version_by_number_or_alias(triton: Triton, leagues: Storage, version: str, number: int) -> None:
    policy, signature = policy_of(leagues, "board", number)
    arrays = observations(signature, 8)
    result = triton.infer("board", arrays, version=version, request_id="tick 7")
    assert_same(result.as_numpy("action"), policy.act(arrays).actions)
    response = result.get_response() if triton.is_http else result.get_response(as_json=True)
    assert (response["model_name"], response["model_version"], response["id"]) == ("board", str(number), "tick 7")


def test_by_default_all_outputs_are_returned(triton: Triton, leagues: Storage) -> None:
    _, signature = policy_of(leagues, "board")
    result = triton.infer("board", observations(signature, 2))
    assert all(array is not None for array in outputs_of(result, OUTPUTS).values())


@pytest.mark.parametrize("requested", [["action"], ["action_dist_inputs"], ["action_dist_inputs", "action"]])
@pytest.mark.parametrize("binary", [True, False], ids=["binary", "json"])
def test_outputs_can_be_selected(triton: Triton, leagues: Storage, requested: list[str], binary: bool) -> None:
    _, signature = policy_of(leagues, "board")
    result = triton.infer("board", observations(signature, 2), outputs=requested, binary=binary)
    found = outputs_of(result, OUTPUTS)
    assert [name for name in OUTPUTS if found[name] is not None] == sorted(requested)
    response = result.get_response() if triton.is_http else result.get_response(as_json=True)
    assert [output["name"] for output in response["outputs"]] == requested


def test_recurrent_state_is_an_input_and_an_output(triton: Triton) -> None:
    ones, state = np.ones((2, 1), np.float32), {}
    actions = []
    for _ in range(4):
        result = triton.infer("memory", {"observation": ones} | state)
        state = {"state_in_0": result.as_numpy("state_out_0")}
        actions.append(result.as_numpy("action").tolist())
    assert actions == [[0, 0], [0, 0], [1, 1], [1, 1]]
    assert_same(state["state_in_0"], np.full((2, 1), 4, np.float32))
    assert "state_in_<i>" in error_of(triton, "memory", {"observation": ones}, sequence_id=7, sequence_start=True)


@pytest.mark.parametrize("encoding", ["gzip", "deflate"])
@pytest.mark.parametrize("binary", [True, False], ids=["binary", "json"])
def test_both_directions_can_be_compressed(over_http: Triton, leagues: Storage, encoding: str, binary: bool) -> None:
    policy, signature = policy_of(leagues, "chess")
    arrays = observations(signature, 2)
    expected = policy.distribution(arrays).dist_inputs
    # The asyncio client of tritonclient 2.41 cannot compress requests: it does not import gzip.
    options = {} if over_http.is_async else {"request_compression_algorithm": encoding}
    result = over_http.infer(
        "chess", arrays, outputs=OUTPUTS, binary=binary, response_compression_algorithm=encoding, **options
    )
    assert expected is not None
    assert_same(result.as_numpy("action_dist_inputs"), expected)


@pytest.mark.parametrize("encoding", ["gzip", "deflate"])
def test_calls_can_be_compressed(over_grpc: Triton, leagues: Storage, encoding: str) -> None:
    policy, signature = policy_of(leagues, "pistons")
    arrays = observations(signature, 2)
    result = over_grpc.infer("pistons", arrays, compression_algorithm=encoding)
    assert_same(result.as_numpy("action"), policy.act(arrays).actions)


def test_health(triton: Triton) -> None:
    assert triton.call("is_server_live")
    assert triton.call("is_server_ready")
    for model, version, is_ready in [
        ("board", "", True),
        ("board", "3", True),
        ("board", "champion", True),
        ("board", "9", False),
        ("board", "rival", False),
        ("nobody", "", False),
        ("empty", "", False),
        ("headless", "1", True),
        ("duo", "", False),
        ("duo.right", "", True),
    ]:
        assert triton.call("is_model_ready", model, version) is is_ready, (model, version)


def test_the_server_has_metadata(triton: Triton) -> None:
    metadata = triton.document("get_server_metadata")
    assert metadata["name"] == "policy-league"
    assert {"binary_tensor_data", "statistics"} <= set(metadata["extensions"])


def test_a_model_has_metadata_and_a_configuration(triton: Triton) -> None:
    metadata = triton.document("get_model_metadata", "board", "champion")
    assert (metadata["name"], metadata["versions"]) == ("board", ["1", "2", "3"])
    shapes = [
        (tensor["name"], tensor["datatype"], [int(size) for size in tensor["shape"]]) for tensor in metadata["inputs"]
    ]
    assert shapes == [("observation", "INT8", [-1, 6, 7, 2]), ("action_mask", "INT8", [-1, 7])]
    assert [(tensor["name"], tensor["datatype"]) for tensor in metadata["outputs"]] == [
        ("action", "INT64"),
        ("action_dist_inputs", "FP32"),
    ]
    config = triton.document("get_model_config", "memory")
    config = config if triton.is_http else config["config"]
    assert (config["max_batch_size"], config["backend"]) == (8, "onnxruntime")
    assert [(port["name"], port.get("optional", False)) for port in config["input"]] == [
        ("observation", False),
        ("state_in_0", True),
    ]


def test_the_index_lists_all_versions(triton: Triton) -> None:
    index = triton.document("get_model_repository_index")
    models = index if triton.is_http else index["models"]
    found = {(model["name"], model["version"]): model["state"] for model in models}
    assert {("board", "1"), ("board", "3"), ("duo.left", "1"), ("duo.right", "1"), ("headless", "1")} <= found.keys()
    assert found["board", "1"] == "READY"
    assert not [name for name, _ in found if name in ("duo", "empty")]


def test_statistics_count_rows_and_runs(triton: Triton, leagues: Storage) -> None:
    def count() -> list[int]:
        (entry,) = triton.document("get_inference_statistics", "vector", "1")["model_stats"]
        inferred = entry["inference_stats"]
        numbers = [entry.get("inference_count", 0), entry.get("execution_count", 0)]
        return [
            int(number)
            for number in (*numbers, *(inferred[outcome].get("count", 0) for outcome in ("success", "fail")))
        ]

    _, signature = policy_of(leagues, "vector")
    before = count()
    for rows in (1, 5):
        triton.infer("vector", observations(signature, rows))
    error_of(triton, "vector", {"observation": np.zeros((1, 3), np.float32)})
    assert [after - earlier for after, earlier in zip(count(), before, strict=True)] == [6, 2, 2, 1]


@pytest.mark.parametrize(
    ("model", "version", "message"),
    [
        ("nobody", "", "nobody"),
        ("Board", "", "must consist of"),
        ("board.other", "", "no policy 'other'"),
        ("duo", "", "several policies"),
        ("board", "99", "no version 99"),
        ("board", "rival", "no alias 'rival'"),
        ("empty", "", "has no champion"),
    ],
)
def test_an_unknown_model_is_reported(triton: Triton, leagues: Storage, model: str, version: str, message: str) -> None:
    _, signature = policy_of(leagues, "board")
    with pytest.raises(InferenceServerException) as caught:
        triton.infer(model, observations(signature, 1), version=version)
    assert message in caught.value.message()


BAD_TENSORS: dict[str, tuple[dict[str, Any], str]] = {
    "a missing input": ({"action_mask": None}, "input action_mask is missing"),
    "another name": ({"action_mask": None, "mask": np.ones((2, 7), np.int8)}, "unknown input 'mask'"),
    "another datatype": ({"action_mask": np.ones((2, 7), np.float32)}, "has datatype FP32, expected INT8"),
    "a half for a byte": ({"action_mask": np.ones((2, 7), np.float16)}, "has datatype FP16, expected INT8"),
    "strings": ({"action_mask": np.full((2, 7), b"1", object)}, "has datatype BYTES, expected INT8"),
    "another shape": ({"action_mask": np.ones((2, 8), np.int8)}, "has shape [2, 8], expected [batch, 7]"),
    "no batch": ({"action_mask": np.ones(7, np.int8)}, "has shape [7], expected [batch, 7]"),
    "an empty batch": ({"action_mask": np.ones((0, 7), np.int8)}, "has shape [0, 7], expected [batch, 7]"),
    "other rows": ({"action_mask": np.ones((1, 7), np.int8)}, "different numbers of rows"),
    "nothing legal": ({"action_mask": np.zeros((2, 7), np.int8)}, "at least one 1"),
    "a mask of twos": ({"action_mask": np.full((2, 7), 2, np.int8)}, "other than 0 and 1"),
    "too many rows": ({"action_mask": np.ones((9, 7), np.int8)}, "expected at most 8"),
}


@pytest.mark.parametrize("name", BAD_TENSORS)
@pytest.mark.parametrize("binary", [True, False], ids=["binary", "json"])
def test_invalid_tensors_are_rejected(triton: Triton, leagues: Storage, name: str, binary: bool) -> None:
    changes, message = BAD_TENSORS[name]
    _, signature = policy_of(leagues, "board")
    arrays = {of: array for of, array in (observations(signature, 2) | changes).items() if array is not None}
    assert message in error_of(triton, "board", arrays, binary=binary)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_must_be_finite(triton: Triton, value: float) -> None:
    assert "finite" in error_of(triton, "vector", {"observation": np.array([[0, value]], np.float32)})


def test_a_discrete_observation_must_be_in_range(triton: Triton) -> None:
    assert "between 0 and 3" in error_of(triton, "choice", {"observation": np.array([4])})


def test_an_unknown_output_is_rejected(triton: Triton, leagues: Storage) -> None:
    _, signature = policy_of(leagues, "board")
    arrays = observations(signature, 1)
    assert "unknown output 'value', expected action" in error_of(triton, "board", arrays, outputs=["value"])
    assert "requested twice" in error_of(triton, "board", arrays, outputs=["action", "action"])


def test_a_decompression_bomb_is_rejected(clients: dict[str, Triton]) -> None:
    limit = 512 * 1024
    huge = np.zeros((8, limit // 2), np.int8)
    message = error_of(clients["http"], "board", {"observation": huge}, request_compression_algorithm="gzip")
    assert f"decompressed body is larger than {limit} bytes" in message
    assert len(zlib.compress(huge.tobytes())) < limit // 50


def test_unsupported_features_are_rejected(triton: Triton, leagues: Storage) -> None:
    tensor = triton.module.InferInput("observation", [1, 2], "FP32")
    tensor.set_shared_memory("region", 8)
    with pytest.raises(InferenceServerException, match="shared_memory_region, which this server does not support"):
        triton.call("infer", "vector", [tensor])
    classes = triton.module.InferRequestedOutput("action", class_count=2)
    _, signature = policy_of(leagues, "vector")
    tensor = triton.module.InferInput("observation", [1, 2], "FP32")
    tensor.set_data_from_numpy(observations(signature, 1)["observation"])
    with pytest.raises(InferenceServerException, match="classification, which this server does not support"):
        triton.call("infer", "vector", [tensor], outputs=[classes])


@pytest.mark.parametrize("version", ["", "2"])
def test_perf_analyzer_finds_the_version_that_answered(triton: Triton, leagues: Storage, version: str) -> None:
    """It looks for the version whose count in the queue rose between two statistics that both list it."""

    def queued() -> dict[str, int]:
        entries = triton.document("get_inference_statistics", "board", version)["model_stats"]
        return {entry["version"]: int(entry["inference_stats"]["queue"].get("count", 0)) for entry in entries}

    before = queued()
    for _ in range(3):
        triton.infer("board", observations(policy_of(leagues, "board")[1], 1), version=version)
    risen = {number: count - before[number] for number, count in queued().items() if count > before[number]}
    assert risen == {version or "1": 3}
