"""The Open Inference Protocol over gRPC: messages to requests and back, and the service that answers them."""

from functools import lru_cache, partial
from ipaddress import IPv6Address, ip_address
from time import perf_counter_ns
from typing import Any, cast
from urllib.parse import unquote

import grpc
from google.protobuf.json_format import ParseDict
from google.protobuf.message import DecodeError, Message

from league.errors import ArtifactCorrupt, BodyTooLarge, InvalidInput, LeagueError, NotFound, NotReady, StorageError
from serve_app.access.access_control import AccessControl, headers_of
from serve_app.access.errors import BodyTooSlow
from serve_app.access.request_body import MAX_CHANGE_BODY
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.inference_protocol.catalogue import ModelCatalogue
from serve_app.inference_protocol.field_count import check_fields, malformed
from serve_app.inference_protocol.inference import API, Inference, InferRequest, Outputs
from serve_app.inference_protocol.rest_codec import SEQUENCE, UNSUPPORTED
from serve_app.inference_protocol.statistics import Document
from serve_app.inference_protocol.tensors import Data, RequestTensor, datatype_of, to_bytes
from serve_app.live_versions.policies import LoadedPolicy
from serve_app.live_versions.registry_watcher import RegistryWatcher
from serve_app.runtime.timeouts import TimeLimitExceeded, run_within
from serve_app.settings import ServeSettings

CONTENTS = {
    "BOOL": "bool_contents",
    "INT8": "int_contents",
    "INT16": "int_contents",
    "INT32": "int_contents",
    "INT64": "int64_contents",
    "UINT8": "uint_contents",
    "UINT16": "uint_contents",
    "UINT32": "uint_contents",
    "UINT64": "uint64_contents",
    "FP32": "fp32_contents",
    "FP64": "fp64_contents",
}
"""Field with the elements of a datatype if they are not sent as bytes. FP16 has none."""


FEW_TENSORS = 64
"""Requests with more are compared with the policy's inputs and outputs before they are read."""


def check_counts(request: messages.ModelInferRequest, policy: LoadedPolicy) -> None:
    """Raise InvalidInput if a request has more tensors than a policy."""
    for what, names, most in (
        ("inputs", request.inputs, policy.inputs),
        ("raw_input_contents", request.raw_input_contents, policy.inputs),
        ("outputs", request.outputs, policy.outputs),
    ):
        if len(names) > len(most):
            raise InvalidInput(f"the request has {len(names)} {what}, expected at most {len(most)}")


def read_request(request: messages.ModelInferRequest, size: int) -> InferRequest:
    """Convert a message of `size` bytes to a request. Raises InvalidInput."""
    for tensor in (*request.inputs, *request.outputs):
        for name in UNSUPPORTED:
            if name in tensor.parameters:
                raise InvalidInput(f"{tensor.name[:64]!r} requests {name}, which this server does not support")
    raw_inputs = request.raw_input_contents
    if raw_inputs and len(raw_inputs) != len(request.inputs):
        raise InvalidInput(f"{len(raw_inputs)} raw_input_contents for {len(request.inputs)} inputs, expected one each")
    sequence = request.parameters.get(SEQUENCE)
    return InferRequest(
        id=request.id,
        inputs=[_tensor(tensor, raw_inputs[i] if raw_inputs else None) for i, tensor in enumerate(request.inputs)],
        outputs=[output.name for output in request.outputs],
        size=size,
        is_sequence=sequence is not None and bool(sequence.int64_param or sequence.string_param),
    )


def _tensor(tensor: messages.ModelInferRequest.InferInputTensor, contents: bytes | None) -> RequestTensor:
    data: Data
    if contents is not None:
        if tensor.HasField("contents"):
            raise InvalidInput(f"input {tensor.name[:64]!r} has both contents and raw_input_contents")
        data = contents
    elif (field := CONTENTS.get(tensor.datatype)) is not None:
        data = getattr(tensor.contents, field)
    else:
        raise InvalidInput(f"input {tensor.name[:64]!r} has datatype {tensor.datatype[:64]!r}: send it as bytes")
    return RequestTensor(tensor.name, tensor.datatype, tensor.shape, data)


def write_response(request: messages.ModelInferRequest, version: int, outputs: Outputs) -> messages.ModelInferResponse:
    """Convert a response to a message, with all outputs as bytes."""
    return messages.ModelInferResponse(
        model_name=request.model_name,
        model_version=str(version),
        id=request.id,
        outputs=[
            messages.ModelInferResponse.InferOutputTensor(name=name, datatype=datatype_of(array), shape=array.shape)
            for name, array in outputs.items()
        ],
        raw_output_contents=[to_bytes(array) for array in outputs.values()],
    )


@lru_cache(maxsize=1024)  # constant for a connection
def is_local_peer(peer: str, machine: str) -> bool:
    """Whether a peer address is on this machine: `ipv4:127.0.0.1:4711`, `ipv6:%5B::1%5D:4711`, `unix:` or the node's
    address.
    """
    kind, _, endpoint = unquote(peer).partition(":")
    if kind == "unix":
        return True
    try:
        address = ip_address(endpoint.rpartition(":")[0].strip("[]"))
    except ValueError:
        return False
    if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    return address.is_loopback or str(address) == machine


INFER = "ModelInfer"
EMPTY = ("ServerLive", "ServerReady", "ServerMetadata")
"""RPCs whose messages have no fields; they are not read."""


class InferenceService:
    """The gRPC service of a replica. `machine`: the node's address."""

    def __init__(
        self,
        inference: Inference,
        catalogue: ModelCatalogue,
        watcher: RegistryWatcher,
        access: AccessControl,
        settings: ServeSettings,
        machine: str,
    ) -> None:
        self._inference = inference
        self._catalogue = catalogue
        self._watcher = watcher
        self._access = access
        self._settings = settings
        self._machine = machine

    async def call(self, rpc: str, request_type: type[Message], context: grpc.aio.ServicerContext) -> Message:
        """Answer a call. Raises LeagueError.

        The caller is known before its message is read, and the message is small before it is parsed.
        """
        if self._settings.grpc_local_only and not is_local_peer(context.peer(), self._machine):
            raise NotReady("replicas accept gRPC from their own machine only: call the server's port")
        metadata, model = context.invocation_metadata(), ""
        try:
            key = self._access.admit_rpc(metadata, rpc)
            if rpc in EMPTY:
                return await self._answer(rpc, request_type())
            with self._inference.serving.admitted(API):
                body = await self._read(context, self._settings.max_body if rpc == INFER else MAX_CHANGE_BODY)
                if len(body) > LARGE_BODY:
                    self._access.admit_body(key, len(body))
                start, request = perf_counter_ns(), cast(Any, parse(body, request_type))
                model = request.model_name if rpc == INFER else getattr(request, "name", "")
                self._access.check_model(key, rpc, model)
                if rpc != INFER:
                    return await self._answer(rpc, request)
                policy = await self._inference.find(model, request.model_version, headers_of(metadata))
                if max(len(request.inputs), len(request.outputs), len(request.raw_input_contents)) > FEW_TENSORS:
                    check_counts(request, policy)
                write = partial(write_response, request, policy.number)
                return await self._inference.infer(policy, read_request(request, len(body)), write, start)
        except LeagueError as error:
            self._inference.serving.metrics.count_error(f"/v2/models/{model}", error.code)
            raise

    async def _read(self, context: grpc.aio.ServicerContext, limit: int) -> bytes:
        """Read the message of a call. Raises BodyTooSlow or BodyTooLarge."""
        try:
            body = await run_within(self._settings.timeout, context.read())
        except TimeLimitExceeded:
            raise BodyTooSlow(f"the message did not arrive within {self._settings.timeout:g} s") from None
        if not isinstance(body, bytes):  # the call has no message, or one above the limit of the server
            body = b""
        if len(body) > limit:
            raise BodyTooLarge(f"the message is larger than {limit} bytes")
        return body

    async def _answer(self, rpc: str, request: Any) -> Message:
        """Answer a call that is not ModelInfer."""
        catalogue = self._catalogue
        match rpc:
            case "ServerLive":
                document: Document = {"live": True}
            case "ServerReady":
                document = {"ready": self._watcher.is_ready}
            case "ModelReady":
                document = {"ready": True}
                try:
                    await self._inference.find(request.name, request.version)
                except (NotFound, NotReady, ArtifactCorrupt, StorageError):
                    document = {"ready": False}
            case "ServerMetadata":
                document = catalogue.server()
            case "ModelMetadata":
                document = await catalogue.metadata(request.name, request.version)
            case "ModelConfig":
                document = {"config": await catalogue.config(request.name, request.version)}
            case "ModelStatistics":
                document = await catalogue.statistics(request.name, request.version)
            case "RepositoryIndex":
                document = {"models": await catalogue.index(request.ready)}
        response: Message = getattr(messages, f"{rpc}Response")()
        return ParseDict(document, response)


def parse(body: bytes, request_type: type[Message]) -> Message:
    """Parse a message. Raises BodyTooLarge or MalformedBody."""
    check_fields(body, request_type.DESCRIPTOR)
    try:
        return request_type.FromString(body)
    except DecodeError:
        raise malformed(request_type.DESCRIPTOR) from None
