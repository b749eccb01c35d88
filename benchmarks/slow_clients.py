"""Clients that behave badly: they connect and say nothing, or send so slowly that they are never done."""

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from itertools import cycle
from urllib.parse import urlsplit

PAUSE = 0.2
"""Seconds between two bytes of one that dribbles."""
KINDS = ("silent", "in the head", "in the body", "half a head")


@contextmanager
def slow_clients(url: str, request: bytes, count: int) -> Iterator[None]:
    """Hold so many connections while the context lasts; one that the server closes is opened again.

    request: the bytes of a good request, of which they never send the whole. In equal parts they are silent, dribble in
    the head, dribble in the body, or stop in the middle of the head.
    """
    begun, stop = threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: asyncio.run(_hold(url, request, count, begun, stop)))
    thread.start()
    begun.wait()
    try:
        yield
    finally:
        stop.set()
        thread.join()


async def _hold(url: str, request: bytes, count: int, begun: threading.Event, stop: threading.Event) -> None:
    kinds = cycle(KINDS)
    tasks = [asyncio.create_task(_again_and_again(url, request, next(kinds), stop)) for _ in range(count)]
    await asyncio.sleep(PAUSE)
    begun.set()
    while not stop.is_set():
        await asyncio.sleep(PAUSE)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


async def _again_and_again(url: str, request: bytes, kind: str, stop: threading.Event) -> None:
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
    """Until the server closes the connection."""
    body = request.index(b"\r\n\r\n") + 4
    at = {"silent": 0, "in the head": 10, "in the body": body + 5, "half a head": body // 2}[kind]
    writer.write(request[:at])
    while not reader.at_eof():
        if kind.startswith("in") and at < len(request) - 1:
            writer.write(request[at : at + 1])
            at += 1
        with suppress(TimeoutError):
            await asyncio.wait_for(reader.read(4096), PAUSE)
