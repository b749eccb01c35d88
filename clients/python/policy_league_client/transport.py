"""I/O primitives of the two clients, each as an asyncio variant and a blocking variant of the same name."""

import asyncio
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection as _AsyncConnection
from websockets.asyncio.client import connect as _async_connect
from websockets.sync.client import ClientConnection as _Connection
from websockets.sync.client import connect as _connect

from policy_league_client.loopback import is_loopback
from policy_league_client.proxies import usable_proxies

CLOSE_TIMEOUT = 1.0
"""Seconds that a server has to confirm the end of a WebSocket connection."""

AsyncConnection = _AsyncConnection
Connection = _Connection

async_sleep = asyncio.sleep
sleep = time.sleep

AsyncCancelled = asyncio.CancelledError
Cancelled = KeyboardInterrupt
"""Raised in the middle of an operation by the caller, not by the connection."""

async_time_limit = asyncio.timeout


def time_limit(_: float) -> AbstractContextManager[None]:
    """Does nothing: blocking operations have timeouts of their own."""
    return nullcontext()


async def async_connect(url: str, headers: Mapping[str, str], timeout: float) -> AsyncConnection:
    """Open a WebSocket connection."""
    with usable_proxies():
        return await _async_connect(url, **_options(url, headers, timeout))


def connect(url: str, headers: Mapping[str, str], timeout: float) -> Connection:
    """Open a WebSocket connection."""
    with usable_proxies():
        return _connect(url, **_options(url, headers, timeout))


def _options(url: str, headers: Mapping[str, str], timeout: float) -> dict[str, Any]:
    return {
        "additional_headers": headers,
        "compression": None,
        "open_timeout": timeout,
        "close_timeout": CLOSE_TIMEOUT,
        "max_size": None,
        "proxy": None if is_loopback(urlsplit(url).hostname or "") else True,
    }


async def async_receive(connection: AsyncConnection, _: float) -> str | bytes:
    """Receive a message. The caller limits the time with `async_time_limit`."""
    return await connection.recv()


def receive(connection: Connection, timeout: float) -> str | bytes:
    """Receive a message within `timeout` seconds. Raises TimeoutError."""
    return connection.recv(timeout)
