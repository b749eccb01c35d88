"""gRPC without a client library: tensors in the fields of their datatype, invalid messages, and local peers."""

import gc
import os
import socket
import sys
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any
from unittest.mock import Mock

import grpc
import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from league.errors import BodyTooLarge
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.access.errors import MalformedBody
from serve_app.app import Replica
from serve_app.inference_protocol import grpc_handlers, grpc_service
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.inference_protocol.field_count import MAX_FIELDS, check_fields
from serve_app.inference_protocol.grpc_service import CONTENTS, is_local_peer
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


def status_of(call: Call, request: Any, rpc: str = "ModelInfer") -> tuple[grpc.StatusCode, str]:
    with pytest.raises(grpc.RpcError) as caught:
        call(rpc, request)
    return caught.value.code(), str(caught.value.details())  # type: ignore[attr-defined]


def error_of(call: Call, request: Any, rpc: str = "ModelInfer") -> str:
    code, message = status_of(call, request, rpc)
    assert code in CLIENT_ERRORS, message
    return message


def vector(**changes: Any) -> messages.ModelInferRequest:
    """A valid request, with changes to its input."""
    tensor = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "contents": {"fp32_contents": [0.5, -1]}}
    inputs = [Input(**{key: value for key, value in (tensor | changes).items() if value is not None})]
    return messages.ModelInferRequest(model_name="vector", inputs=inputs)


def test_tensors_in_the_field_of_their_datatype(call: Call, leagues: Storage) -> None:
    policy, ports = policy_of(leagues, "kinds")
    arrays = observations(ports, 2)
    # FP16 has no field, and raw contents must be given for all inputs or for none.
    tensors = [
        Input(name=name, datatype=datatype, shape=arrays[name].shape, contents=contents)
        for name, port in ports.items()
        if (datatype := port.datatype) != "FP16"
        for contents in [{CONTENTS[datatype]: arrays[name].ravel().tolist()}]
    ]
    assert len(tensors) == len(DTYPES) - 1
    half = Input(name="observation.float16", datatype="FP16", shape=[2, 2, 3])
    request = messages.ModelInferRequest(model_name="kinds", inputs=[*tensors, half])
    assert "send it as bytes" in error_of(call, request)
    del request.inputs[-1]
    assert "input observation.float16 is missing" in error_of(call, request)
    request.inputs.append(half)
    for tensor in request.inputs:
        tensor.ClearField("contents")
        request.raw_input_contents.append(arrays[tensor.name].tobytes())
    actions = np.frombuffer(call("ModelInfer", request).raw_output_contents[0], np.float32)
    np.testing.assert_array_equal(actions.reshape(2, -1), policy.act(arrays).actions)


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


def test_an_invalid_request_is_rejected(call: Call, replica: InProcess, subtests: pytest.Subtests) -> None:
    for changes, message in (
        ({"contents": {"fp32_contents": [1]}}, "has 1 elements, expected 2"),
        ({"contents": {"fp64_contents": [1, 2]}}, "has 0 elements, expected 2"),
        ({"contents": None}, "has 0 elements, expected 2"),
        ({"datatype": ""}, "datatype ''"),
        ({"shape": [-1, 2]}, "has shape [-1, 2]"),
        ({"contents": {"fp32_contents": [float("nan"), 0]}}, "finite"),
    ):
        with subtests.test(changes=changes):
            assert message in error_of(call, vector(**changes))
    request = vector()
    for contents, message in (
        ([bytes(8)], "both contents and raw_input_contents"),
        ([bytes(8)] * 2, "2 raw_input_contents for 1 inputs"),
        ([bytes(7)], "has 7 bytes, expected 8"),
    ):
        with subtests.test(contents=contents):
            del request.raw_input_contents[:]
            request.raw_input_contents.extend(contents)
            assert message in error_of(call, request)
        request.inputs[0].ClearField("contents")
    large = messages.ModelInferRequest(model_name="vector", raw_input_contents=[bytes(600 * 1024)])
    assert "larger than 524288 bytes" in error_of(call, large)
    empty = messages.ModelInferRequest(model_name="vector").SerializeToString()
    for part, what in ((b"\x2a\0", "inputs"), (b"\x32\0", "outputs"), (b"\x3a\0", "raw_input_contents")):
        with subtests.test(what):
            assert f"the request has 5000 {what}, expected at most" in error_of(call, empty + 5000 * part)
            assert "more than 10000 fields" in error_of(call, empty + 200_000 * part)
    for rpc, query, code in (
        ("ModelStatistics", messages.ModelStatisticsRequest(name="nobody"), grpc.StatusCode.NOT_FOUND),
        ("ModelInfer", messages.ModelInferRequest(model_name="empty"), grpc.StatusCode.UNAVAILABLE),
    ):
        assert status_of(call, query, rpc)[0] == code
    with grpc.insecure_channel(replica.grpc) as channel, pytest.raises(grpc.RpcError) as caught:
        channel.stream_unary(f"/{grpc_handlers.SERVICE}/ModelInfer")(iter([]))
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
            assert slow.server.serving.in_flight["infer"] == 0
        ends.set()
    assert caught.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED  # type: ignore[attr-defined]


def test_the_number_of_concurrent_calls_is_limited(
    call: Call, replica: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(replica.server.serving.in_flight, "infer", 10**6)
    assert "in progress in this replica" in error_of(call, vector())


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
    code, message = status_of(call, messages.ServerLiveRequest(), "ServerLive")
    assert (code, "this process has no replica" in message) == (grpc.StatusCode.UNAVAILABLE, True)


def test_an_unexpected_exception_is_only_logged(
    call: Call, replica: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replica.server.catalogue, "server", Mock(side_effect=ZeroDivisionError("secret")))
    code, message = status_of(call, messages.ServerMetadataRequest(), "ServerMetadata")
    assert (code, "secret" in message) == (grpc.StatusCode.INTERNAL, False)


def external_address() -> str | None:
    """An address of this machine other than the loopback address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing, but selects the route
        except OSError:
            return None
        address = str(probe.getsockname()[0])
    return None if address.startswith("127.") else address


tensors = st.builds(
    Input,
    name=st.sampled_from(["observation", "action_mask", "state_in_0"]) | st.text(max_size=5),
    datatype=st.sampled_from([*CONTENTS, "FP16", "BYTES"]) | st.text(max_size=4),
    shape=st.lists(st.integers(-1, 3) | st.just(2**62), max_size=4),
    parameters=st.dictionaries(st.text(max_size=2), st.builds(messages.InferParameter, int64_param=st.integers(0, 9))),
    contents=st.none()
    | st.builds(
        messages.InferTensorContents,
        fp32_contents=st.lists(st.floats(width=32), max_size=4),
        int_contents=st.lists(st.integers(-(2**31), 2**31 - 1), max_size=4),
        bool_contents=st.lists(st.booleans(), max_size=4),
    ),
)
outputs = st.builds(
    messages.ModelInferRequest.InferRequestedOutputTensor,
    name=st.sampled_from(["action", "action_dist_inputs"]) | st.text(max_size=5),
)
requests = st.builds(
    messages.ModelInferRequest,
    model_name=st.sampled_from(["board", "vector", "memory", "nested", "chess", "duo", "duo.left"]),
    model_version=st.sampled_from(["", "1", "champion", "99", "x y"]),
    inputs=st.lists(tensors, max_size=3),
    outputs=st.lists(outputs, max_size=3),
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


def test_local_and_remote_peers() -> None:
    local = [
        "ipv4:127.0.0.1:4711",
        "ipv4:127.8.0.1:4711",
        "ipv6:[::1]:4711",
        "ipv6:%5B::1%5D:4711",
        "ipv6:[::ffff:127.0.0.1]:4711",
        "ipv4:192.0.2.1:4711",
        "ipv6:[::ffff:192.0.2.1]:4711",
        "unix:",
        "unix:/run/socket",
    ]
    elsewhere = ["ipv4:192.0.2.2:4711", "ipv6:[2001:db8::1]:4711", "ipv6:[::ffff:192.0.2.2]:4711"]
    for peer in (*local, *elsewhere, "ipv4:127.0.0.1", "", "localhost"):
        assert is_local_peer(peer, "192.0.2.1") is (peer in local), peer


INPUTS, OUTPUTS, PARAMETERS, RAW, UNKNOWN, GROUP = b"\x2a\0", b"\x32\0", b"\x22\0", b"\x3a\0", b"\x78\1", b"\x0b\x0c"


def field(number: int, content: bytes) -> bytes:
    """A field with a length, as the wire format encodes it."""
    return (
        messages.ModelInferRequest(raw_input_contents=[content])
        .SerializeToString()
        .replace(b"\x3a", bytes([number << 3 | 2]), 1)
    )


def test_messages_with_many_fields_are_too_large() -> None:
    for body in (
        *(MAX_FIELDS * part for part in (INPUTS, OUTPUTS, PARAMETERS, RAW, UNKNOWN, GROUP)),
        field(5, MAX_FIELDS * PARAMETERS),
        field(5, MAX_FIELDS * b"\x18\1"),  # dimensions
        field(5, field(5, MAX_FIELDS * b"\x42\0")),  # elements of bytes_contents
        field(5, field(5, MAX_FIELDS * b"\x18\1")),  # elements of int64_contents, not packed
        field(6, MAX_FIELDS * b"\x12\0"),
        field(4, field(2, MAX_FIELDS * b"\x10\1")),
    ):
        with pytest.raises(BodyTooLarge, match=f"more than {MAX_FIELDS} fields"):
            check_fields(body + UNKNOWN, messages.ModelInferRequest.DESCRIPTOR)


PADDING = field(3, bytes(MAX_FIELDS))


def test_messages_that_are_cut_off_are_malformed() -> None:
    for cut in (
        11 * b"\xff",  # an integer
        b"\x2a",  # a length
        b"\x2a\2\0",  # content
        b"\x0d\0",  # 32 bits
        b"\x09\0",  # 64 bits
        b"\x0f\0",  # a wire type
        field(5, b"\x0a\7name"),  # inner content
    ):
        with pytest.raises(DecodeError):
            messages.ModelInferRequest.FromString(PADDING + cut)
        with pytest.raises(MalformedBody, match="not a valid ModelInferRequest"):
            check_fields(PADDING + cut, messages.ModelInferRequest.DESCRIPTOR)


def test_a_large_message_with_few_fields_passes() -> None:
    contents = messages.InferTensorContents(int64_contents=[1] * 1_000_000)
    inputs = [Input(name="x", datatype="INT64", shape=[1000, 1000], contents=contents)]
    check_fields(
        messages.ModelInferRequest(model_name="m", inputs=inputs).SerializeToString(),
        messages.ModelInferRequest.DESCRIPTOR,
    )
    check_fields(
        messages.ModelInferRequest(raw_input_contents=[bytes(4_000_000)]).SerializeToString(),
        messages.ModelInferRequest.DESCRIPTOR,
    )


@given(message=requests, damage=st.binary(max_size=8))
def test_no_message_that_the_parser_accepts_is_malformed(message: Any, damage: bytes) -> None:
    body = PADDING + message.SerializeToString() + damage
    try:
        messages.ModelInferRequest.FromString(body)
    except DecodeError:
        return
    check_fields(body, messages.ModelInferRequest.DESCRIPTOR)
