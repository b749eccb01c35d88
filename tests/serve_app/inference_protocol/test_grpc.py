"""gRPC without a client library: tensors in the fields of their datatype, and invalid messages."""

import gc
import os
import socket
import sys
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import grpc
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Replica
from serve_app.inference_protocol import grpc_handlers, grpc_service
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.inference_protocol.grpc_service import CONTENTS
from serve_app.runtime.timeouts import run_within
from tests.support.clients.protocol_observations import observations, policy_of
from tests.support.examples import examples
from tests.support.leagues.protocol_leagues import DTYPES
from tests.support.servers.protocol_servers import SETTINGS, InProcess, Listening
from tests.support.waiting import until

Call = Callable[[str, Any], Any]
Input = messages.ModelInferRequest.InferInputTensor
CLIENT_ERRORS = {
    grpc.StatusCode.INVALID_ARGUMENT,
    grpc.StatusCode.NOT_FOUND,
    grpc.StatusCode.RESOURCE_EXHAUSTED,
}


@pytest.fixture(scope="module")
def call(replica: InProcess) -> Iterator[Call]:
    """Call an RPC by name, with a message or its bytes."""
    with grpc.insecure_channel(replica.grpc) as channel:

        def call(rpc: str, request: Any) -> Any:
            answer = getattr(messages, f"{rpc}Response").FromString
            content = request if isinstance(request, bytes) else request.SerializeToString()
            return channel.unary_unary(f"/{grpc_handlers.SERVICE}/{rpc}", None, answer)(content)

        yield call


def error_of(call: Call, request: Any, rpc: str = "ModelInfer") -> str:
    with pytest.raises(grpc.RpcError) as caught:
        call(rpc, request)
    assert caught.value.code() in CLIENT_ERRORS, caught.value  # type: ignore[attr-defined]
    return str(caught.value.details())  # type: ignore[attr-defined]


def vector(**changes: Any) -> messages.ModelInferRequest:
    """A valid request, with changes to its input."""
    tensor = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "contents": {"fp32_contents": [0.5, -1]}}
    inputs = [Input(**{key: value for key, value in (tensor | changes).items() if value is not None})]
    return messages.ModelInferRequest(model_name="vector", inputs=inputs)


def test_tensors_in_the_field_of_their_datatype(call: Call, leagues: Storage) -> None:
    policy, signature = policy_of(leagues, "kinds")
    arrays = observations(signature, 2)
    # FP16 has no field, and raw contents must be given for all inputs or for none.
    without = [name for name in arrays if signature.inputs[name].datatype != "FP16"]
    assert len(without) == len(DTYPES) - 1
    inputs = [
        Input(
            name=name,
            datatype=signature.inputs[name].datatype,
            shape=arrays[name].shape,
            contents={CONTENTS[signature.inputs[name].datatype]: arrays[name].ravel().tolist()},
        )
        for name in without
    ]
    half = Input(name="observation.float16", datatype="FP16", shape=[2, 2, 3])
    request = messages.ModelInferRequest(model_name="kinds", inputs=[*inputs, half])
    assert "send it as bytes" in error_of(call, request)
    del request.inputs[-1]
    assert "input observation.float16 is missing" in error_of(call, request)
    for tensor in request.inputs:
        tensor.ClearField("contents")
    request.inputs.append(half)
    request.raw_input_contents.extend(
        [*(arrays[name].tobytes() for name in without), arrays["observation.float16"].tobytes()]
    )
    answer = call("ModelInfer", request)
    np.testing.assert_array_equal(
        np.frombuffer(answer.raw_output_contents[0], np.float32).reshape(2, -1), policy.act(arrays).actions
    )


def test_outputs_are_raw_contents(call: Call) -> None:
    request = vector()
    request.id = "tick"
    answer = call("ModelInfer", request)
    assert (answer.model_name, answer.model_version, answer.id) == ("vector", "1", "tick")
    assert [(output.name, output.datatype, list(output.shape)) for output in answer.outputs] == [
        ("action", "FP32", [1, 2]),
        ("action_dist_inputs", "FP32", [1, 4]),
    ]
    assert answer.raw_output_contents[0] == np.array([0.5, -1], "<f4").tobytes()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contents": {"fp32_contents": [1]}}, "has 1 elements, expected 2"),
        ({"contents": {"fp64_contents": [1, 2]}}, "has 0 elements, expected 2"),
        ({"contents": None}, "has 0 elements, expected 2"),
        ({"datatype": "FP64"}, "has datatype FP64, expected FP32"),
        ({"datatype": ""}, "datatype ''"),
        ({"shape": [2]}, "has shape [2], expected [batch, 2]"),
        ({"shape": [-1, 2]}, "has shape [-1, 2]"),
        ({"name": "other"}, "unknown input 'other'"),
        ({"contents": {"fp32_contents": [float("nan"), 0]}}, "finite"),
    ],
)
def test_an_invalid_tensor_is_rejected(call: Call, changes: dict[str, Any], message: str) -> None:
    assert message in error_of(call, vector(**changes))


def test_raw_contents_are_for_all_inputs_or_for_none(call: Call) -> None:
    request = vector()
    request.raw_input_contents.append(bytes(8))
    assert "both contents and raw_input_contents" in error_of(call, request)
    request.inputs[0].ClearField("contents")
    request.raw_input_contents.append(bytes(8))
    assert "2 raw_input_contents for 1 inputs" in error_of(call, request)
    del request.raw_input_contents[:]
    request.raw_input_contents.append(bytes(7))
    assert "has 7 bytes, expected 8" in error_of(call, request)


def test_a_large_message_is_rejected(call: Call, replica: InProcess) -> None:
    request = messages.ModelInferRequest(model_name="vector", raw_input_contents=[bytes(600 * 1024)])
    assert "larger than 524288 bytes" in error_of(call, request)


@pytest.mark.parametrize(
    ("part", "message"),
    [(b"\x2a\0", "inputs"), (b"\x32\0", "outputs"), (b"\x3a\0", "raw_input_contents")],
)
def test_more_tensors_than_those_of_the_policy_are_rejected(call: Call, part: bytes, message: str) -> None:
    request = messages.ModelInferRequest(model_name="vector").SerializeToString()
    assert f"the request has 5000 {message}, expected at most" in error_of(call, request + 5000 * part)
    assert "more than 10000 fields" in error_of(call, request + 200_000 * part)


def test_a_call_without_a_message_is_refused(replica: InProcess) -> None:
    with grpc.insecure_channel(replica.grpc) as channel:
        infer = channel.stream_unary(f"/{grpc_handlers.SERVICE}/ModelInfer")
        with pytest.raises(grpc.RpcError) as caught:
            infer(iter([]))
    assert caught.value.code() in CLIENT_ERRORS  # type: ignore[attr-defined]


def test_a_message_that_does_not_arrive_is_not_waited_for(leagues: Storage) -> None:
    settings = SETTINGS.model_copy(update={"timeout": 0.1})
    ends = threading.Event()

    def never() -> Iterator[bytes]:
        ends.wait()
        yield b""

    with Listening(Replica(Registry.open(leagues), settings, "replica-2")) as slow:
        with grpc.insecure_channel(slow.grpc) as channel:
            infer = channel.stream_unary(f"/{grpc_handlers.SERVICE}/ModelInfer")
            with pytest.raises(grpc.RpcError, match=r"did not arrive within 0\.1 s") as caught:
                infer(never())
            assert slow.server.inference.in_flight == 0
        ends.set()
    assert caught.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED  # type: ignore[attr-defined]


def test_the_number_of_concurrent_calls_is_limited(
    call: Call, replica: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replica.server.inference, "in_flight", 10**6)
    assert "in progress in this replica" in error_of(call, vector())


def test_unknown_models_and_missing_champions_are_reported(call: Call) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        call("ModelStatistics", messages.ModelStatisticsRequest(name="nobody"))
    assert caught.value.code() == grpc.StatusCode.NOT_FOUND  # type: ignore[attr-defined]
    with pytest.raises(grpc.RpcError) as caught:
        call("ModelInfer", messages.ModelInferRequest(model_name="empty"))
    assert caught.value.code() == grpc.StatusCode.UNAVAILABLE  # type: ignore[attr-defined]


def test_remote_calls_are_rejected(replica: InProcess) -> None:
    """The port listens on all interfaces, like Ray Serve's; this replica is known as 127.0.0.1."""
    external, port = external_address(), replica.grpc.rpartition(":")[2]
    if external is None:
        pytest.skip("this machine has only the loopback address")
    with grpc.insecure_channel(f"{external}:{port}") as channel:
        live = channel.unary_unary(f"/{grpc_handlers.SERVICE}/ServerLive")
        with pytest.raises(grpc.RpcError, match="from their own machine only") as caught:
            live(b"", timeout=60)  # a busy machine may need more than 10 s
    assert caught.value.code() == grpc.StatusCode.UNAVAILABLE  # type: ignore[attr-defined]


def test_a_process_without_a_replica_is_unavailable(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grpc_handlers, "_service", None)
    with pytest.raises(grpc.RpcError, match="this process has no replica") as caught:
        call("ServerLive", messages.ServerLiveRequest())
    assert caught.value.code() == grpc.StatusCode.UNAVAILABLE  # type: ignore[attr-defined]


def test_an_unexpected_exception_is_only_logged(
    call: Call, replica: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise ZeroDivisionError("secret")

    monkeypatch.setattr(replica.server.catalogue, "server", fail)
    with pytest.raises(grpc.RpcError) as caught:
        call("ServerMetadata", messages.ServerMetadataRequest())
    assert caught.value.code() == grpc.StatusCode.INTERNAL  # type: ignore[attr-defined]
    assert "secret" not in caught.value.details()  # type: ignore[attr-defined]


def external_address() -> str | None:
    """An address of this machine other than the loopback address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing, but selects the route
        except OSError:
            return None
        address = str(probe.getsockname()[0])
    return None if address.startswith("127.") else address


names = st.sampled_from(["observation", "action_mask", "state_in_0"]) | st.text(max_size=5)
requests = st.builds(
    messages.ModelInferRequest,
    model_name=st.sampled_from(["board", "vector", "memory", "nested", "chess", "duo", "duo.left"]),
    model_version=st.sampled_from(["", "1", "champion", "99", "x y"]),
    inputs=st.lists(
        st.builds(
            Input,
            name=names,
            datatype=st.sampled_from([*CONTENTS, "FP16", "BYTES"]) | st.text(max_size=4),
            shape=st.lists(st.integers(-1, 3) | st.just(2**62), max_size=4),
            contents=st.none()
            | st.builds(
                messages.InferTensorContents,
                fp32_contents=st.lists(st.floats(width=32), max_size=4),
                int_contents=st.lists(st.integers(-(2**31), 2**31 - 1), max_size=4),
                bool_contents=st.lists(st.booleans(), max_size=4),
            ),
        ),
        max_size=3,
    ),
    outputs=st.lists(
        st.builds(
            messages.ModelInferRequest.InferRequestedOutputTensor,
            name=st.sampled_from(["action", "action_dist_inputs"]) | st.text(max_size=5),
        ),
        max_size=3,
    ),
    raw_input_contents=st.lists(st.binary(max_size=100), max_size=3),
)


@examples(300)
@given(request=requests | st.binary(max_size=60))
def test_no_message_causes_a_server_error(call: Call, request: Any) -> None:
    failure = None
    try:
        call("ModelInfer", request)
    except grpc.RpcError as error:
        failure = error
    assert failure is None or failure.code() in CLIENT_ERRORS, failure  # type: ignore[attr-defined]


def test_rejected_messages_are_released_at_once(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not by the garbage collector, which may run after hundreds of calls."""
    received: list[bytes] = []

    async def keep(seconds: float, reading: Awaitable[bytes]) -> bytes:
        received.append(await run_within(seconds, reading))
        return received[-1]

    monkeypatch.setattr(grpc_service, "run_within", keep)
    gc.disable()
    try:
        error_of(call, messages.ModelReadyRequest(name="x" * 100_000), "ModelReady")  # too large
        error_of(call, b"\xff" * 1000, "ModelReady")  # malformed
        # Only the list refers to them.
        until(lambda: references(received) == references([os.urandom(1000) for _ in range(2)]))
    finally:
        gc.enable()


def references(received: list[bytes]) -> list[int]:
    """The number of references to each message."""
    return [sys.getrefcount(message) for message in received]
