"""Two clients of both protocols: the unmodified one in each form, and remote models as contestants of our versions."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import grpc
import numpy as np
import pytest
from tritonclient.utils import InferenceServerException

from league.config.opponents import OpponentConfig
from league.environments.stepping import Batch
from league.errors import ConfigError, EnvironmentMismatch, InvalidReference, RemoteError, UnknownPolicy
from league.interface import AgentInterface, Interface
from league.policies.loading import contestant, pinned, requested
from league.policies.open_inference import OpenInferencePolicy, fixed_version
from league.refs import RemoteRef, parse_ref
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces import Box, Discrete
from serve_app.app import Replica
from serve_app.inference_protocol import grpc_handlers
from tests.support.clients.protocol_observations import observations, policy_of
from tests.support.clients.triton import FORMS, Triton, assert_same, outputs_of
from tests.support.leagues.served_leagues import everything
from tests.support.servers.protocol_servers import Address, InProcess, Listening
from tests.support.servers.replicas import QUICK
from training.sampling.opponents import OpponentPolicy, Opponents

MODELS = ("board", "board.shared", "duo.left", "vector", "nested", "choice", "chess", "pistons", "kinds")
OUTPUTS = ("action", "action_dist_inputs")


CLIENT_ERRORS = {"400", "404", "413"} | {
    f"StatusCode.{name}" for name in ("INVALID_ARGUMENT", "NOT_FOUND", "RESOURCE_EXHAUSTED")
}


@pytest.fixture(scope="module")
def clients(replica: Address) -> Iterator[dict[str, Triton]]:
    with ExitStack() as stack:
        yield {form: stack.enter_context(Triton(form, replica)) for form in FORMS}


@pytest.fixture(params=FORMS)
def triton(request: pytest.FixtureRequest, clients: dict[str, Triton]) -> Triton:
    return clients[request.param]


def error_of(triton: Triton, *arguments: Any, **options: Any) -> str:
    """The message with which an inference is rejected; fails on a server error."""
    with pytest.raises(InferenceServerException) as caught:
        triton.infer(*arguments, **options)
    assert caught.value.status() in CLIENT_ERRORS, caught.value
    return str(caught.value.message())


def test_each_tensor_type(clients: dict[str, Triton], leagues: Storage) -> None:
    """Over HTTP in both encodings, over gRPC, and one of them by the asynchronous clients."""
    for model in MODELS:
        policy, ports = policy_of(leagues, model)
        for rows in (1, 3):
            arrays = observations(ports, rows)
            expected = policy.distribution(arrays)
            assert expected.dist_inputs is not None
            for form, binary in (
                ("http", True),
                ("http", False),
                ("grpc", True),
                ("http.aio", True),
                ("grpc.aio", True),
            ):
                if model == "nested" or not clients[form].is_async:
                    result = clients[form].infer(model, arrays, outputs=OUTPUTS, binary=binary)
                    assert_same(result.as_numpy("action"), expected.actions)
                    assert_same(result.as_numpy("action_dist_inputs"), expected.dist_inputs)


def test_a_version_by_number_or_alias(triton: Triton, leagues: Storage) -> None:
    for version, number in (("", 1), ("1", 1), ("2", 2), ("3", 3), ("champion", 1)):
        policy, ports = policy_of(leagues, "board", number)
        arrays = observations(ports, 8)
        result = triton.infer("board", arrays, version=version, request_id="tick 7")
        assert_same(result.as_numpy("action"), policy.act(arrays).actions)
        assert all(array is not None for array in outputs_of(result, OUTPUTS).values()), "by default all"
        response = result.get_response() if triton.is_http else result.get_response(as_json=True)
        assert (response["model_name"], response["model_version"], response["id"]) == ("board", str(number), "tick 7")


def test_outputs_can_be_selected(triton: Triton, leagues: Storage) -> None:
    _, ports = policy_of(leagues, "board")
    for names in (["action"], ["action_dist_inputs"], ["action_dist_inputs", "action"]):
        for binary in (True, False):
            result = triton.infer("board", observations(ports, 2), outputs=names, binary=binary)
            arrays = outputs_of(result, OUTPUTS)
            assert [name for name in OUTPUTS if arrays[name] is not None] == sorted(names)
            response = result.get_response() if triton.is_http else result.get_response(as_json=True)
            assert [output["name"] for output in response["outputs"]] == names


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


def test_health(triton: Triton) -> None:
    assert triton.call("is_server_live")
    assert triton.call("is_server_ready")
    ready = [("board", ""), ("board", "3"), ("board", "champion"), ("headless", "1"), ("duo.right", "")]
    for model, version in (*ready, ("board", "9"), ("board", "rival"), ("nobody", ""), ("empty", ""), ("duo", "")):
        is_ready = triton.call("is_model_ready", model, version)
        assert is_ready is ((model, version) in ready), (model, version)


def test_server_and_models_are_described(triton: Triton) -> None:
    server = triton.document("get_server_metadata")
    assert (server["name"], {"binary_tensor_data", "statistics"} <= set(server["extensions"])) == (
        "policy-league",
        True,
    )
    metadata = triton.document("get_model_metadata", "board", "champion")
    assert (metadata["name"], metadata["versions"]) == ("board", ["1", "2", "3"])
    inputs = [(port["name"], port["datatype"], [int(size) for size in port["shape"]]) for port in metadata["inputs"]]
    assert inputs == [("observation", "INT8", [-1, 6, 7, 2]), ("action_mask", "INT8", [-1, 7])]
    outputs = [(port["name"], port["datatype"]) for port in metadata["outputs"]]
    assert outputs == [("action", "INT64"), ("action_dist_inputs", "FP32")]
    config = triton.document("get_model_config", "memory")
    config = config if triton.is_http else config["config"]
    assert (config["max_batch_size"], config["backend"]) == (8, "onnxruntime")
    inputs = [(port["name"], port.get("optional", False)) for port in config["input"]]
    assert inputs == [("observation", False), ("state_in_0", True)]
    index = triton.document("get_model_repository_index")
    models = index if triton.is_http else index["models"]
    states = {(model["name"], model["version"]): model["state"] for model in models}
    assert {("board", "1"), ("board", "3"), ("duo.left", "1"), ("duo.right", "1"), ("headless", "1")} <= states.keys()
    assert states["board", "1"] == "READY"
    assert not [name for name, _ in states if name in ("duo", "empty")]


def test_statistics_count_rows_and_runs(triton: Triton, leagues: Storage) -> None:
    def count() -> list[int]:
        (entry,) = triton.document("get_inference_statistics", "vector", "1")["model_stats"]
        inferred = entry["inference_stats"]
        numbers = [entry.get("inference_count", 0), entry.get("execution_count", 0)]
        return [
            int(number)
            for number in (*numbers, *(inferred[outcome].get("count", 0) for outcome in ("success", "fail")))
        ]

    _, ports = policy_of(leagues, "vector")
    before = count()
    for rows in (1, 5):
        triton.infer("vector", observations(ports, rows))
    error_of(triton, "vector", {"observation": np.zeros((1, 3), np.float32)})
    assert [after - earlier for after, earlier in zip(count(), before, strict=True)] == [6, 2, 2, 1]


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


OTHER_TENSORS: tuple[tuple[str, Any, str], ...] = (
    *(("vector", np.array([[0, value]], np.float32), "finite") for value in (np.nan, np.inf, -np.inf)),
    ("choice", np.array([4]), "between 0 and 3"),
)
UNKNOWN_MODELS = (
    ("nobody", "", "nobody"),
    ("Board", "", "must consist of"),
    ("board.other", "", "no policy 'other'"),
    ("duo", "", "several policies"),
    ("board", "99", "no version 99"),
    ("board", "rival", "no alias 'rival'"),
)


def test_invalid_requests_are_rejected(triton: Triton, leagues: Storage, subtests: pytest.Subtests) -> None:
    valid = observations(policy_of(leagues, "board")[1], 2)
    for name, (changes, message) in BAD_TENSORS.items():
        arrays = {of: array for of, array in (valid | changes).items() if array is not None}
        for binary in (True, False):
            with subtests.test(name, binary=binary):
                assert message in error_of(triton, "board", arrays, binary=binary)
    for model, array, message in OTHER_TENSORS:
        with subtests.test(array=array):
            assert message in error_of(triton, model, {"observation": array})
    for model, version, message in UNKNOWN_MODELS:
        with subtests.test(model=model, version=version):
            assert message in error_of(triton, model, valid, version=version)
    with pytest.raises(InferenceServerException, match="has no champion"):
        triton.infer("empty", valid)
    assert "unknown output 'value', expected action" in error_of(triton, "board", valid, outputs=["value"])
    assert "requested twice" in error_of(triton, "board", valid, outputs=["action", "action"])


def test_unsupported_features_are_rejected(triton: Triton, leagues: Storage) -> None:
    tensor = triton.module.InferInput("observation", [1, 2], "FP32")
    tensor.set_shared_memory("region", 8)
    with pytest.raises(InferenceServerException, match="shared_memory_region, which this server does not support"):
        triton.call("infer", "vector", [tensor])
    classes = triton.module.InferRequestedOutput("action", class_count=2)
    _, ports = policy_of(leagues, "vector")
    tensor = triton.module.InferInput("observation", [1, 2], "FP32")
    tensor.set_data_from_numpy(observations(ports, 1)["observation"])
    with pytest.raises(InferenceServerException, match="classification, which this server does not support"):
        triton.call("infer", "vector", [tensor], outputs=[classes])


def test_perf_analyzer_finds_the_version_that_answered(triton: Triton, leagues: Storage) -> None:
    """It looks for the version whose count in the queue rose between two statistics that both list it."""

    def queued() -> dict[str, int]:
        entries = triton.document("get_inference_statistics", "board", version)["model_stats"]
        return {entry["version"]: int(entry["inference_stats"]["queue"].get("count", 0)) for entry in entries}

    arrays = observations(policy_of(leagues, "board")[1], 1)
    for version in ("", "2"):
        before = queued()
        for _ in range(3):
            triton.infer("board", arrays, version=version)
        risen = {number: count - before[number] for number, count in queued().items() if count > before[number]}
        assert risen == {version or "1": 3}


VECTOR = {"observation": np.zeros((1, 2), np.float32)}
STATUS = {
    "unknown": {True: "401", False: "StatusCode.UNAUTHENTICATED"},
    "wrong": {True: "403", False: "StatusCode.PERMISSION_DENIED"},
}


@pytest.fixture(scope="module")
def locked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[InProcess, dict[str, str]]]:
    """A replica that requires keys, and a token for each scope."""
    registry = everything(Storage.at(tmp_path_factory.mktemp("locked")))
    tokens = {scope: registry.keys.create(scope, [scope])[1] for scope in ("act", "read")}
    with Listening(Replica(Registry.open(registry.storage), QUICK, "replica-1")) as address:
        yield address, tokens
    registry.close()


@pytest.mark.parametrize("form", FORMS)
def test_a_key_is_limited_to_its_scope(locked: tuple[InProcess, dict[str, str]], form: str) -> None:
    address, tokens = locked
    acts, reads = ({"authorization": f"Bearer {tokens[scope]}"} for scope in ("act", "read"))
    with Triton(form, address) as triton:

        def assert_rejected(reason: str, call: str, *arguments: object, **options: object) -> None:
            with pytest.raises(InferenceServerException) as caught:
                (triton.infer if call == "infer" else triton.call)(*arguments, **options)  # type: ignore[operator]
            assert caught.value.status() == STATUS[reason][triton.is_http]

        assert triton.infer("vector", VECTOR, headers=acts).as_numpy("action") is not None
        assert triton.call("get_model_metadata", "vector", headers=reads)
        assert triton.call("is_server_ready")
        assert_rejected("unknown", "infer", "vector", VECTOR)
        wrong = {"authorization": f"Bearer {tokens['act'][:-1]}x"}
        assert_rejected("unknown", "infer", "vector", VECTOR, headers=wrong)
        assert_rejected("wrong", "infer", "vector", VECTOR, headers=reads)
        assert_rejected("unknown", "get_model_metadata", "get_model_metadata", "vector")
        assert_rejected("wrong", "get_model_repository_index", "get_model_repository_index", headers=acts)


def test_a_caller_without_a_key_is_refused_before_its_message_arrives(
    locked: tuple[InProcess, dict[str, str]], subtests: pytest.Subtests
) -> None:
    ends = threading.Event()

    def never() -> Iterator[bytes]:
        ends.wait()
        yield b""

    with grpc.insecure_channel(locked[0].grpc) as channel:
        for rpc in ("ModelInfer", "ModelReady", "ModelStatistics", "RepositoryIndex", "ServerMetadata"):
            with subtests.test(rpc), pytest.raises(grpc.RpcError) as caught:
                channel.stream_unary(f"/{grpc_handlers.SERVICE}/{rpc}")(never(), timeout=4)
            assert caught.value.code() == grpc.StatusCode.UNAUTHENTICATED  # type: ignore[attr-defined]
        ends.set()


def interface_of(storage: Storage, league: str) -> Interface:
    registry = Registry.open(storage)
    try:
        return registry.leagues.get(league).interface
    finally:
        registry.close()


def remote(replica: Address, model: str) -> RemoteRef:
    return RemoteRef(f"http://{replica.http}", model)


def test_a_remote_model_acts_as_the_version(
    replica: Address, leagues: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("league.policies.open_inference.MAX_ROWS", 8)  # the server's limit in these tests
    for model, rows in (("board", 5), ("vector", 17), ("nested", 5), ("choice", 5), ("pistons", 5)):
        policy, ports = policy_of(leagues, model)
        arrays = observations(ports, rows)
        for _, acting in contestant(str(remote(replica, model)), None, interface_of(leagues, model)).values():
            np.testing.assert_array_equal(acting.act(arrays).actions, policy.act(arrays).actions)


def test_a_key_is_sent_only_to_the_server_that_it_is_for(
    replica: InProcess, leagues: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    received = list[str | None]()
    admit = replica.server.access.admission

    def record(scope: Any, path: str) -> Any:
        admission = admit(scope, path)
        received.append(None if admission.headers.token is None else admission.headers.token.decode())
        return admission

    monkeypatch.setattr(replica.server.access, "admission", record)
    host = replica.http.partition(":")[2]
    interface = interface_of(leagues, "board")
    for variable, sent in (
        (f"http://other.example=wrong http://127.0.0.1:{host}/=right=", "right="),
        (f"https://{replica.http}=wrong http://127.0.0.1:1=wrong", None),
        ("", None),
    ):
        monkeypatch.setenv("LEAGUE_REMOTE_API_KEY", variable)
        fixed_version(remote(replica, "board"), interface)
        assert set(received) == {sent}
        received.clear()
    for variable in ("secret", "secret==", f"http://{replica.http}", f"http://{replica.http}="):
        monkeypatch.setenv("LEAGUE_REMOTE_API_KEY", variable)
        with pytest.raises(ConfigError, match="expected SERVER=KEY") as caught:
            fixed_version(remote(replica, "board"), interface)
        assert "secret" not in str(caught.value)


def test_a_recurrent_model_remembers_as_an_opponent_in_training(replica: Address, leagues: Storage) -> None:
    ref = str(remote(replica, "memory"))
    interface = interface_of(leagues, "memory")
    opponents = Opponents([OpponentConfig(ref=ref, share=1.0)], interface, None, num_envs=2)
    opponent = OpponentPolicy(ref, interface.policy_ids[0])
    batch = Batch(np.arange(2), np.zeros(2, np.int64), {"observation": np.ones((2, 1), np.float32)}, np.zeros(2))

    def act() -> list[int]:
        return opponents.act(opponent, batch, np.random.default_rng(0)).tolist()

    assert [act() for _ in range(3)] == [[0, 0], [0, 0], [1, 1]]
    opponents.forget(np.array([0]))
    assert act() == [0, 1]


def test_a_remote_model_is_pinned_to_the_version_that_answers(replica: Address, leagues: Storage) -> None:
    for model in ("board", "duo.{policy}"):
        fixed = fixed_version(remote(replica, model), interface_of(leagues, model.partition(".")[0]))
        assert str(fixed) == f"http://{replica.http}/v2/models/{model}/versions/1"
    registry = Registry.open(leagues)
    reference = f"http://{replica.http}/v2/models/board/versions"
    assert pinned(f"{reference}/champion", "board", registry) == f"{reference}/1"
    with pytest.raises(UnknownPolicy, match="its remote models: none"):
        requested("http://127.0.0.1:1/v2/models/board", "board", registry)
    registry.close()


def test_another_model_is_refused(replica: Address, leagues: Storage) -> None:
    interface = interface_of(leagues, "board")
    with pytest.raises(EnvironmentMismatch, match=r"has the input observation FP32 \[-1, 2\]: expected observation"):
        fixed_version(remote(replica, "vector"), interface)
    with pytest.raises(RemoteError, match="/v2/models/nothing returned status 404"):
        fixed_version(remote(replica, "nothing"), interface)
    changed = RemoteRef(f"http://{replica.http}", "board", digest="0" * 12)
    with pytest.raises(EnvironmentMismatch, match="have changed"):
        contestant(str(changed), None, interface)


def test_an_unreachable_server_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("league.policies.open_inference.RETRY_DEADLINE", 0.0)
    spaces = AgentInterface(observation=Box(dtype="float32", shape=(2,), low=None, high=None), action=Discrete(n=2))
    with pytest.raises(RemoteError, match="/v2/models/gone cannot be reached"):
        OpenInferencePolicy(RemoteRef("http://127.0.0.1:1", "gone"), "shared", spaces)


def test_references_are_written_as_they_are_read_and_other_urls_refused() -> None:
    models = ("http://host:8000/v2/models/board", "https://host/prefix/v2/models/board.{policy}/versions/7")
    for text in (*models, "http://host:8000/v2/models/board#0123456789ab"):
        parsed = parse_ref(text)
        assert isinstance(parsed, RemoteRef)
        assert str(parsed) == text
    for text in (
        "http://host:8000",
        "http://user@host/v2/models/m",
        "http://host/v2/models/a{b}",
        f"http://{'h' * 300}",
    ):
        with pytest.raises(InvalidReference):
            parse_ref(text)
