"""Peers without Ray: `python -m benchmarks.peers.bare_servers KIND HOME PORT` serves until standard input is closed.

handler: our application with the same policy on a standard uvicorn. fastapi: a simple server with FastAPI, pydantic and
torch on uvicorn, with the same network and one torch thread.
"""

import sys
import threading
from pathlib import Path
from typing import Any

import uvicorn


def handler(home: Path) -> Any:
    """Our ASGI application, following the registry of `home`."""
    from league.registry.registry import Registry
    from league.settings import Storage
    from serve_app.app import Replica
    from serve_app.settings import ServeSettings

    return Replica(Registry.open(Storage.at(home)), ServeSettings(), "bare").application()


def fastapi(_: Path) -> Any:
    """An endpoint with the same request body."""
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

    return application


def main() -> None:
    """Serve."""
    kind, home, port = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    application = {"handler": handler, "fastapi": fastapi}[kind](home)
    server = uvicorn.Server(uvicorn.Config(application, host="127.0.0.1", port=port, log_level="error"))

    def stop() -> None:
        sys.stdin.read()
        server.should_exit = True

    threading.Thread(target=stop, daemon=True).start()
    server.run()


if __name__ == "__main__":
    main()
