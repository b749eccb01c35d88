"""uvicorn, which here looks a hundred times a second whether it should stop, not ten times: many tests start one."""

import asyncio
from types import SimpleNamespace

import uvicorn.server
from uvicorn import Config, Server

__all__ = ["Config", "Server"]

QUICKER = {"sleep": lambda seconds: asyncio.sleep(seconds / 10)}
uvicorn.server.asyncio = SimpleNamespace(**vars(asyncio) | QUICKER)  # type: ignore[assignment]
