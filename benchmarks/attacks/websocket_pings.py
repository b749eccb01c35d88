"""WebSocket streams that send frames which are no messages, as fast as they can: an attack of
`python -m benchmarks.attacks`.
"""

import asyncio
import sys
from contextlib import suppress
from itertools import cycle
from urllib.parse import urlsplit

from benchmarks.leagues.served_league import LEAGUE
from benchmarks.load.websocket import HANDSHAKE, NO_MASK

STREAMS = 6
FLOOD = 64 * 1024
"""Bytes that a stream sends at once."""
PAUSE = 0.05
"""Seconds after a refused handshake."""
FRAMES = (
    b"\x89\x80" + NO_MASK,  # ping
    b"\x8a\x80" + NO_MASK,  # pong
    b"\x89\x84" + NO_MASK + b"ping",
)
FRAGMENTS = b"\x01\x80" + NO_MASK + b"\x00\x80" + NO_MASK + b"\x80\x80" + NO_MASK
"""A message of three empty fragments."""


async def attack(url: str, token: str) -> None:
    """Keep the streams open, and send."""
    parts = urlsplit(url)
    handshake = HANDSHAKE.format(path=f"/v1/policies/{LEAGUE}/stream", host=parts.netloc)
    if token:
        handshake = handshake.replace("\r\n\r\n", f"\r\nX-Api-Key: {token}\r\n\r\n")
    attempts, opened, started = 0, 0, asyncio.Event()

    async def keep_sending(frame: bytes) -> None:
        nonlocal attempts, opened
        flood = frame * (FLOOD // len(frame))
        while True:
            with suppress(OSError, asyncio.IncompleteReadError):
                reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
                writer.write(handshake.encode())
                head = await reader.readuntil(b"\r\n\r\n")
                attempts += 1
                if is_open := head.startswith(b"HTTP/1.1 101"):
                    opened += 1
                if opened == STREAMS or (not token and attempts == STREAMS):
                    started.set()
                if is_open:
                    reading = asyncio.create_task(_discard(reader))
                    with suppress(OSError):
                        while not reading.done():
                            writer.write(flood)
                            await writer.drain()
                    opened -= 1
                writer.transport.abort()
            await asyncio.sleep(PAUSE)

    kinds = cycle((*FRAMES, FRAGMENTS))
    async with asyncio.TaskGroup() as group:
        for _ in range(STREAMS):
            group.create_task(keep_sending(next(kinds)))
        await started.wait()
        print("started", flush=True)


async def _discard(reader: asyncio.StreamReader) -> None:
    while await reader.read(FLOOD):
        pass


if __name__ == "__main__":
    asyncio.run(attack(sys.argv[1], sys.argv[3]))
