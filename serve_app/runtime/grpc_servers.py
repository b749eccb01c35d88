"""The gRPC servers of Ray Serve: where they listen, and what they hold of callers that are not known yet.

Each replica has one for calls from HAProxy, and one for calls from other deployments; Serve's fallback proxy has one.
Ray lets them listen on all interfaces, whatever its node's address is.
"""

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import grpc

ALL_INTERFACES, LOOPBACK = "[::]:", "127.0.0.1:"
API_SERVICE = "/ray.serve.RayServeAPIService/"
"""The service of Ray Serve on the same servers: its health, and the names of applications."""
MAX_CONNECTIONS = 1024
"""Connections to one server; each HAProxy holds a few. Further ones are closed."""
OPTIONS = (
    # Otherwise a server measures how fast a connection is, and lets it send megabytes before anything is read.
    ("grpc.http2.bdp_probe", 0),
    ("grpc.max_allowed_incoming_connections", MAX_CONNECTIONS),
    ("grpc.server_handshake_timeout_ms", 5000),
)
"""Options of gRPC."""


def listen_on_loopback() -> None:
    """Let the gRPC servers of this process listen on the loopback interface."""
    from grpc.aio._server import Server

    original = Server.add_insecure_port

    def add_insecure_port(self: Server, address: str) -> int:
        return original(self, address.replace(ALL_INTERFACES, LOOPBACK, 1))

    Server.add_insecure_port = add_insecure_port


@cache
def limit_unknown_callers() -> None:
    """Limit what the gRPC servers for callers hold of them before they are known, from the next one that starts."""
    import grpc
    from ray.serve._private import constants, grpc_util

    constants.DEFAULT_GRPC_SERVER_OPTIONS.extend(OPTIONS)
    server = grpc_util.gRPCGenericServer
    original = server._override_method_handler

    def override(self: Any, method: str, handler: Any) -> Any:
        overridden = original(self, method, handler)
        if not method.startswith(API_SERVICE):
            return overridden
        answer, request = overridden.unary_unary, overridden.request_deserializer(b"")

        async def answer_unread(_: Any, context: Any) -> Any:
            return await answer(request, context)

        return grpc.stream_unary_rpc_method_handler(answer_unread)  # its messages are empty, and not read

    server._override_method_handler = override


def add_rpc_service(server: "grpc.aio.Server", name: str, handlers: Mapping[str, Any]) -> None:
    """Add a service to a gRPC server. On a server of Ray Serve, its calls bypass the deployment."""
    import grpc

    if hasattr(server, "add_passthrough_service"):
        server.add_passthrough_service(name)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(name, handlers),))
