"""Registers inference.GRPCInferenceService with the gRPC servers of Ray Serve.

    HAProxy → Ray Serve's gRPC server in the replica ┬→ inference.GRPCInferenceService → the replica's service
                                                     └→ other services                 → Ray Serve

`grpc_servicer_functions` of deploy.yaml names `add_service`, which every process with such a server calls. In a replica
its service answers, bypassing Ray Serve's request path. In Ray Serve's fallback proxy, calls fail with UNAVAILABLE.
"""

from operator import methodcaller
from typing import Any, Protocol

import grpc
from google.protobuf.message import Message

from league.errors import LeagueError, NotReady
from serve_app.access.errors import status_of
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.runtime.grpc_servers import add_rpc_service
from serve_app.runtime.ray_serve import logger

SERVICE = "inference.GRPCInferenceService"
CODES = {
    400: grpc.StatusCode.INVALID_ARGUMENT,
    401: grpc.StatusCode.UNAUTHENTICATED,
    403: grpc.StatusCode.PERMISSION_DENIED,
    404: grpc.StatusCode.NOT_FOUND,
    408: grpc.StatusCode.DEADLINE_EXCEEDED,
    409: grpc.StatusCode.FAILED_PRECONDITION,
    413: grpc.StatusCode.RESOURCE_EXHAUSTED,
    415: grpc.StatusCode.INVALID_ARGUMENT,
    429: grpc.StatusCode.RESOURCE_EXHAUSTED,
    503: grpc.StatusCode.UNAVAILABLE,
    504: grpc.StatusCode.DEADLINE_EXCEEDED,
}
"""HTTP status → gRPC status code; INTERNAL for others."""
MAX_MESSAGE_LENGTH = 1024
"""Characters of an error message, which is sent in the trailers."""


class RpcService(Protocol):
    """Answers the calls of a process."""

    async def call(self, rpc: str, request_type: type[Message], context: grpc.aio.ServicerContext) -> Message:
        """Read the message of a call from `context`, and answer it. Raises LeagueError."""


_service: RpcService | None = None


def install(service: RpcService) -> None:
    """Send calls that reach this process to `service`."""
    global _service
    _service = service


def add_service(_: Any, server: grpc.aio.Server) -> None:
    """Add the service to a gRPC server."""
    rpcs = messages.DESCRIPTOR.services_by_name["GRPCInferenceService"].methods
    handlers = {rpc.name: _handler(rpc.name, getattr(messages, rpc.input_type.name)) for rpc in rpcs}
    add_rpc_service(server, SERVICE, handlers)


def _handler(rpc: str, request_type: type[Message]) -> grpc.RpcMethodHandler:
    """The handler of a unary call. It is registered as one that receives a stream, which is the same on the wire: gRPC
    would read and parse the message of a unary call before it asks anybody.
    """

    async def answer(_: Any, context: grpc.aio.ServicerContext) -> Message | None:
        try:
            if _service is None:
                raise NotReady("this process has no replica")
            return await _service.call(rpc, request_type, context)
        except LeagueError as error:
            code, message = CODES.get(status_of(error), grpc.StatusCode.INTERNAL), error.public_message
        except Exception as error:
            logger.error("a call failed", exc_info=error)
            code, message = grpc.StatusCode.INTERNAL, "internal server error; see the server log"
        # `abort` would raise an error that refers to this frame and is referred to by it: until the garbage collector
        # runs, each would keep a message of up to 4 MB.
        context.set_code(code)
        context.set_details(message[:MAX_MESSAGE_LENGTH])
        return None  # no response is sent with an error

    return grpc.stream_unary_rpc_method_handler(answer, response_serializer=methodcaller("SerializeToString"))
