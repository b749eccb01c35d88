"""A replica's application on real sockets, HTTP and gRPC, in a thread, without Ray."""

import asyncio
import threading
from dataclasses import dataclass
from typing import Any

import grpc

from serve_app.app import Replica
from serve_app.inference_protocol import grpc_handlers
from tests.support.servers.prompt_uvicorn import Config, Server
from tests.support.servers.replicas import READ_ONLY

SETTINGS = READ_ONLY.model_copy(update={"max_body": 512 * 1024})


@dataclass(frozen=True)
class Address:
    """Where a server listens, in the form that `tritonclient` takes."""

    http: str
    grpc: str


@dataclass(frozen=True)
class InProcess(Address):
    """A server of this process, whose internals tests may inspect."""

    server: Replica


class Listening:
    """Runs a server's event loop in a thread while the context lasts."""

    def __init__(self, server: Replica) -> None:
        self._server = server
        # A client of asyncio notices only while it is called that the server has closed its idle connection.
        options: dict[str, Any] = {"log_level": "warning", "ws": "none", "timeout_keep_alive": 600}
        self._http = Server(Config(server.application(), host="127.0.0.1", port=0, **options))
        self._is_listening = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()))
        self._grpc_port = 0

    def __enter__(self) -> InProcess:
        self._thread.start()
        assert self._is_listening.wait(30)
        (listener,) = self._http.servers
        port = listener.sockets[0].getsockname()[1]
        return InProcess(f"127.0.0.1:{port}", f"127.0.0.1:{self._grpc_port}", self._server)

    def __exit__(self, *_: object) -> None:
        self._http.should_exit = True
        self._thread.join()

    async def _run(self) -> None:
        former = grpc_handlers._service  # a process has one, but a test may start a second replica for a while
        grpc_handlers.install(self._server.inference_service)
        rpc = grpc.aio.server()
        grpc_handlers.add_service(None, rpc)
        self._grpc_port = rpc.add_insecure_port("[::]:0")  # as Ray Serve does
        await rpc.start()
        serving = asyncio.create_task(self._http.serve())
        while not self._http.started and not serving.done():
            await asyncio.sleep(0.01)
        self._is_listening.set()
        await serving
        await rpc.stop(None)
        grpc_handlers._service = former
