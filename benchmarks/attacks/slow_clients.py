"""Misbehaving clients: they connect and send nothing, or so slowly that they never finish."""

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from itertools import cycle
from urllib.parse import urlsplit

PAUSE = 0.2
"""Seconds between two bytes of a slow client."""
KINDS = ("silent", "in the head", "in the body", "half a head")


@contextmanager
def slow_clients(url: str, request: bytes, count: int) -> Iterator[None]:
    """Hold this number of connections while the context lasts; closed ones are reopened.

    request: a valid request that is never sent completely. In equal parts the clients send nothing, send the header
    slowly, send the body slowly, or stop within the header.
    """
    started, stop = threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: asyncio.run(_hold(url, request, count, started, stop)))
    thread.start()
    started.wait()
    try:
        yield
    finally:
        stop.set()
        thread.join()


async def _hold(url: str, request: bytes, count: int, started: threading.Event, stop: threading.Event) -> None:
    kinds = cycle(KINDS)
    tasks = [asyncio.create_task(_reconnect(url, request, next(kinds), stop)) for _ in range(count)]
    await asyncio.sleep(PAUSE)
    started.set()
    while not stop.is_set():
        await asyncio.sleep(PAUSE)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def _reconnect(url: str, request: bytes, kind: str, stop: threading.Event) -> None:
    while not stop.is_set():
        with suppress(OSError, asyncio.IncompleteReadError):
            async with _connected(url) as (reader, writer):
                await _misbehave(reader, writer, request, kind)
        await asyncio.sleep(PAUSE)


@asynccontextmanager
async def _connected(url: str) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    parts = urlsplit(url)
    reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
    try:
        yield reader, writer
    finally:
        writer.transport.abort()


async def _misbehave(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: bytes, kind: str) -> None:
    """Send slowly until the server closes the connection."""
    body = request.index(b"\r\n\r\n") + 4
    at = {"silent": 0, "in the head": 10, "in the body": body + 5, "half a head": body // 2}[kind]
    writer.write(request[:at])
    while not reader.at_eof():
        if kind.startswith("in") and at < len(request) - 1:
            writer.write(request[at : at + 1])
            at += 1
        with suppress(TimeoutError):
            await asyncio.wait_for(reader.read(4096), PAUSE)
