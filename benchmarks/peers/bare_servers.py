"""Peers without Ray: `python -m benchmarks.peers.bare_servers KIND HOME PORT` serves until standard input is closed.

handler: our application with the same policy on uvicorn, with the protocol of replicas. Its peers answer the same
request with the action only, from the published graph and ONNX Runtime with one thread. fastapi: FastAPI and pydantic
on uvicorn; fastapi_torch: the same with torch. asgi: an ASGI application without a framework on uvicorn. protocol:
a protocol of asyncio on uvloop and orjson, which checks nothing. grpc: our gRPC service on grpc.aio. empty_grpc:
grpc.aio, which answers the same call with an empty message.
"""

import asyncio
import gc
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, cast

import orjson
import psutil
import uvicorn
import uvloop

from benchmarks.harness import ROOT
from benchmarks.peers.graph_policy import GraphPolicy
from serve_app.runtime import haproxy
from tests.support.waiting import until

LENGTH = b"content-length: "
RESPONSE = b"HTTP/1.1 200 OK\r\ncontent-type: application/json\r\ncontent-length: %d\r\n\r\n%b"
START_TIMEOUT = 180.0
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
    from serve_app.runtime.replica_process import collect_rarely
    from serve_app.runtime.uvicorn_http import HttpProtocol
    from serve_app.settings import ServeSettings

    settings = ServeSettings()
    replica = Replica(Registry.open(Storage.at(home)), settings, "bare")
    uvicorn_websocket.install(settings.max_body, settings.max_incomplete)
    application = replica.application()
    collect_rarely()
    return application, partial(HttpProtocol, replica.events.end, replica.inference_queue)


def fastapi(home: Path) -> tuple[Any, Any]:
    """FastAPI with ONNX Runtime, and the standard protocol."""
    return _fastapi(_graph(home).act), "auto"


def fastapi_torch(_: Path) -> tuple[Any, Any]:
    """FastAPI with torch, the same network and one thread, and the standard protocol."""
    import torch

    from benchmarks.leagues.served_league import PLANES, MaskedMLP

    torch.set_num_threads(1)
    network = MaskedMLP(PLANES.size, 7).eval()

    def act(board: Any, mask: Any) -> int:
        with torch.inference_mode():
            actions, _ = network(torch.tensor([board], dtype=torch.int8), torch.tensor([mask], dtype=torch.int8))
        return int(actions[0])

    return _fastapi(act), "auto"


def _fastapi(act: Callable[[Any, Any], int]) -> Any:
    """An endpoint with the same request body."""
    from fastapi import FastAPI
    from pydantic import BaseModel

    class Observation(BaseModel):
        observation: list[list[list[int]]]
        action_mask: list[int]

    class Request(BaseModel):
        observation: Observation

    application = FastAPI()

    @application.post("/v1/policies/connect_four/action")
    async def answer(request: Request) -> dict[str, int]:
        return {"action": act(request.observation.observation, request.observation.action_mask)}

    return application


def asgi(home: Path) -> tuple[Any, Any]:
    """An ASGI application without a framework, and the standard protocol."""
    policy = _graph(home)

    async def application(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "http":
            return
        body, more = b"", True
        while more:
            message = await receive()
            body += message["body"]
            more = message["more_body"]
        content = _answer(policy, body)
        headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(content))]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": content})

    return application, "auto"


class ActionProtocol(asyncio.Protocol):
    """A connection that answers every request with an action, one at a time."""

    def __init__(self, policy: GraphPolicy) -> None:
        self._policy = policy
        self._received = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)

    def data_received(self, data: bytes) -> None:
        self._received += data
        end = self._received.find(b"\r\n\r\n") + 4
        if end < 4:
            return
        head = self._received[:end].lower()
        at = head.find(LENGTH) + len(LENGTH)
        body = self._received[end:]
        if len(body) == int(head[at : head.find(b"\r", at)]):
            self._received = b""
            content = _answer(self._policy, body)
            self._transport.write(RESPONSE % (len(content), content))


def _graph(home: Path) -> GraphPolicy:
    (path,) = home.rglob("*.onnx")
    return GraphPolicy(str(path))


def _answer(policy: GraphPolicy, body: bytes) -> bytes:
    observation = orjson.loads(body)["observation"]
    return orjson.dumps({"action": policy.act(observation["observation"], observation["action_mask"])})


async def serve_protocol(home: Path, port: int) -> None:
    """Answer on sockets of asyncio, without a server or a framework."""
    policy = _graph(home)
    await asyncio.get_running_loop().create_server(lambda: ActionProtocol(policy), "127.0.0.1", port)
    await asyncio.to_thread(sys.stdin.read)


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
    from serve_app.runtime.replica_process import collect_rarely
    from serve_app.settings import ServeSettings

    replica = Replica(Registry.open(Storage.at(home)), ServeSettings(), "bare")
    grpc_handlers.install(replica.inference_service)
    grpc_handlers.add_service(None, server)
    collect_rarely()
    application = replica.application()
    async with application.router.lifespan_context(application):
        await server.start()
        await asyncio.to_thread(sys.stdin.read)


@contextmanager
def started(kind: str, home: Path) -> Iterator[tuple[psutil.Process, int]]:
    """The process and the port of a server, which is stopped on exit."""
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    command = [sys.executable, "-m", "benchmarks.peers.bare_servers", kind, str(home), str(port)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, env=environment) as server:
        assert server.stdin is not None
        try:
            until(lambda: server.poll() is not None or not haproxy.is_free("127.0.0.1", port), START_TIMEOUT)
            yield psutil.Process(server.pid), port
        finally:
            server.stdin.close()


def main() -> None:
    """Serve."""
    gc.freeze()  # modules of benchmarks, which a peer would not have
    kind, home, port = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    if kind in ("grpc", "empty_grpc"):
        uvloop.run(serve_grpc(home if kind == "grpc" else None, port))
        return
    if kind == "protocol":
        uvloop.run(serve_protocol(home, port))
        return
    applications = {"handler": handler, "fastapi": fastapi, "fastapi_torch": fastapi_torch, "asgi": asgi}
    application, protocol = applications[kind](home)
    config = uvicorn.Config(
        application, host="127.0.0.1", port=port, http=protocol, log_level="error", access_log=False
    )
    server = uvicorn.Server(config)

    def stop() -> None:
        sys.stdin.read()
        server.should_exit = True

    threading.Thread(target=stop, daemon=True).start()
    server.run()


if __name__ == "__main__":
    main()
