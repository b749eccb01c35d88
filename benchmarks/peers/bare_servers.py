"""Peers without Ray: `python -m benchmarks.peers.bare_servers KIND HOME PORT` serves until standard input is closed.

handler: our application with the same policy on uvicorn, with the protocol of replicas. fastapi: a simple server with
FastAPI, pydantic and torch on uvicorn, with the same network and one torch thread. grpc: our gRPC service on grpc.aio.
empty_grpc: grpc.aio, which answers the same call with an empty message.
"""

import asyncio
import sys
import threading
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn

INFER = "/inference.GRPCInferenceService/ModelInfer"
"""The call of the gRPC servers."""


def handler(home: Path) -> tuple[Any, Any]:
    """Our ASGI application, following the registry of `home`, and the protocol of its connections.

    Installs that of its WebSockets.
    """
    from league.registry.registry import Registry
    from league.settings import Storage
    from serve_app.app import Replica
    from serve_app.runtime import uvicorn_websocket
    from serve_app.runtime.uvicorn_http import HttpProtocol
    from serve_app.settings import ServeSettings

    settings = ServeSettings()
    replica = Replica(Registry.open(Storage.at(home)), settings, "bare")
    uvicorn_websocket.install(settings.max_body, settings.max_incomplete)
    return replica.application(), partial(HttpProtocol, replica.events.end, replica.plain_actions)


def fastapi(_: Path) -> tuple[Any, Any]:
    """An endpoint with the same request body, and the standard protocol."""
    import torch
    from fastapi import FastAPI
    from pydantic import BaseModel

    from benchmarks.leagues.served_league import PLANES, MaskedMLP

    torch.set_num_threads(1)
    network = MaskedMLP(PLANES.size, 7).eval()

    class Observation(BaseModel):
        observation: list[list[list[int]]]
        action_mask: list[int]

    class Request(BaseModel):
        observation: Observation

    application = FastAPI()

    @application.post("/v1/policies/connect_four/action")
    async def act(request: Request) -> dict[str, int]:
        with torch.inference_mode():
            planes = torch.tensor([request.observation.observation], dtype=torch.int8)
            mask = torch.tensor([request.observation.action_mask], dtype=torch.int8)
            action, _ = network(planes, mask)
        return {"action": int(action[0])}

    return application, "auto"


async def serve_grpc(home: Path | None, port: int) -> None:
    """Our gRPC service, following the registry of `home`; without it, one that answers with an empty message."""
    import grpc

    server = grpc.aio.server()
    server.add_insecure_port(f"127.0.0.1:{port}")
    if home is None:

        async def answer(_: bytes, __: Any) -> bytes:
            return b""

        service, _, call = INFER[1:].partition("/")
        handlers = {call: grpc.unary_unary_rpc_method_handler(answer)}
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service, handlers),))
        await server.start()
        await asyncio.to_thread(sys.stdin.read)
        return
    from league.registry.registry import Registry
    from league.settings import Storage
    from serve_app.app import Replica
    from serve_app.inference_protocol import grpc_handlers
    from serve_app.settings import ServeSettings

    replica = Replica(Registry.open(Storage.at(home)), ServeSettings(), "bare")
    grpc_handlers.install(replica.inference_service)
    grpc_handlers.add_service(None, server)
    application = replica.application()
    async with application.router.lifespan_context(application):
        await server.start()
        await asyncio.to_thread(sys.stdin.read)


def main() -> None:
    """Serve."""
    kind, home, port = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    if kind in ("grpc", "empty_grpc"):
        import uvloop

        uvloop.run(serve_grpc(home if kind == "grpc" else None, port))
        return
    application, protocol = {"handler": handler, "fastapi": fastapi}[kind](home)
    server = uvicorn.Server(uvicorn.Config(application, host="127.0.0.1", port=port, http=protocol, log_level="error"))

    def stop() -> None:
        sys.stdin.read()
        server.should_exit = True

    threading.Thread(target=stop, daemon=True).start()
    server.run()


if __name__ == "__main__":
    main()
