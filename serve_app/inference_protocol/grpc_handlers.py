"""gRPC's calls find the replica's service: inference.GRPCInferenceService on the gRPC servers of Ray Serve.

    HAProxy → Ray Serve's gRPC server in the replica ┬→ inference.GRPCInferenceService → the replica's service
                                                     └→ anything else                  → Ray Serve

`grpc_servicer_functions` of deploy.yaml names `add_service`, which every process with such a server calls. Where a
replica is, its service answers, without Ray Serve's handling of a request, as middleware.py has it for HTTP. Ray
Serve's fallback proxy has no replica, and says so.
"""

from typing import Any, Protocol

import grpc
from google.protobuf.message import DecodeError, Message

from league.errors import LeagueError, NotReady
from serve_app.error_handlers import MalformedBody, logger, status_of
from serve_app.inference_protocol import open_inference_pb2 as messages

SERVICE = "inference.GRPCInferenceService"
CODES = {
    400: grpc.StatusCode.INVALID_ARGUMENT,
    401: grpc.StatusCode.UNAUTHENTICATED,
    403: grpc.StatusCode.PERMISSION_DENIED,
    404: grpc.StatusCode.NOT_FOUND,
    409: grpc.StatusCode.FAILED_PRECONDITION,
    413: grpc.StatusCode.RESOURCE_EXHAUSTED,
    415: grpc.StatusCode.INVALID_ARGUMENT,
    429: grpc.StatusCode.RESOURCE_EXHAUSTED,
    503: grpc.StatusCode.UNAVAILABLE,
    504: grpc.StatusCode.DEADLINE_EXCEEDED,
}
"""HTTP status → gRPC's; INTERNAL for any other."""
LONGEST_MESSAGE = 1024
"""Characters of an error, which travels among the headers."""


class Service(Protocol):
    """What answers the calls of a process."""

    async def call(self, rpc: str, request: Message, context: grpc.aio.ServicerContext) -> Message:
        """Answer a call. Raises LeagueError."""
        ...


_service: Service | None = None


def offer(service: Service) -> None:
    """Let calls that reach this process go straight to `service`."""
    global _service
    _service = service


def add_service(_: Any, server: grpc.aio.Server) -> None:
    """Put the service on a gRPC server, of Ray Serve or plain."""
    rpcs = messages.DESCRIPTOR.services_by_name["GRPCInferenceService"].methods
    handlers = {rpc.name: _handler(rpc.name, getattr(messages, rpc.input_type.name)) for rpc in rpcs}
    if hasattr(server, "add_passthrough_service"):  # else Ray Serve would route the calls to a deployment's methods
        server.add_passthrough_service(SERVICE)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handlers),))


def _handler(rpc: str, request_type: Any) -> grpc.RpcMethodHandler:
    def parse(body: bytes) -> Message | None:
        try:
            return request_type.FromString(body)
        except DecodeError:  # gRPC would call it the server's fault
            return None

    async def answer(request: Message | None, context: grpc.aio.ServicerContext) -> Message:
        try:
            if request is None:
                raise MalformedBody(f"the message is no {request_type.DESCRIPTOR.name}")
            if _service is None:
                raise NotReady("no replica answers here")
            return await _service.call(rpc, request, context)
        except LeagueError as error:
            code, told = CODES.get(status_of(error), grpc.StatusCode.INTERNAL), str(error)
        except Exception as error:
            logger.error("a call failed", exc_info=error)
            code, told = grpc.StatusCode.INTERNAL, "the server failed; its log says why"
        await context.abort(code, told[:LONGEST_MESSAGE])
        raise AssertionError("abort raises")

    return grpc.unary_unary_rpc_method_handler(answer, parse, _serialize)


def _serialize(message: Message) -> bytes:
    return message.SerializeToString()
