"""Many WebSocket streams that send nothing: each answers pings, and connects again after it was closed."""

import asyncio
import time
from dataclasses import dataclass, field
from typing import cast
from urllib.parse import urlsplit

from benchmarks.load.elsewhere import Stage
from benchmarks.load.websocket import FINAL, HANDSHAKE, MASKED, NO_MASK, frame_length

CLOSE, PING, PONG = 0x8, 0x9, 0xA
AT_ONCE = 64
"""Handshakes in progress at the same time."""
RETRY = 0.2
"""Seconds after a refused connection."""


@dataclass(slots=True)
class IdleStreams:
    """What the streams saw.

    Attributes:
        closed: Times at which connections were closed, in seconds after all were open.
        codes: Close code → number of connections; "none" for those that were closed without a frame.
        refused: Handshakes without success.
    """

    closed: list[float] = field(default_factory=list)
    codes: dict[str, int] = field(default_factory=dict)
    refused: int = 0


class _IdleStream(asyncio.Protocol):
    """One connection. opened: set to whether the handshake succeeded. closed: to the close code."""

    def __init__(self, handshake: bytes) -> None:
        loop = asyncio.get_running_loop()
        self._handshake = handshake
        self._received = b""
        self._code = "none"
        self.opened: asyncio.Future[bool] = loop.create_future()
        self.closed: asyncio.Future[str] = loop.create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._transport.write(self._handshake)

    def data_received(self, data: bytes) -> None:
        self._received += data
        if not self.opened.done():
            end = self._received.find(b"\r\n\r\n")
            if end < 0:
                return
            self.opened.set_result(self._received.startswith(b"HTTP/1.1 101"))
            self._received = self._received[end + 4 :]
        while (size := frame_length(self._received)) is not None and size <= len(self._received):
            frame, self._received = self._received[:size], self._received[size:]
            self._answer(frame[0] & 0x0F, frame[2:])

    def _answer(self, opcode: int, payload: bytes) -> None:
        if opcode == CLOSE:
            self._code = str(int.from_bytes(payload[:2], "big"))
        if opcode in (CLOSE, PING):
            head = bytes((FINAL | (PONG if opcode == PING else CLOSE), MASKED | len(payload)))
            self._transport.write(head + NO_MASK + payload)

    def connection_lost(self, _: Exception | None) -> None:
        if not self.opened.done():
            self.opened.set_result(False)
        self.closed.set_result(self._code)

    def close(self) -> None:
        self._transport.abort()


async def run(stage: Stage, url: str, number: int) -> IdleStreams:
    """Hold streams until the stage is over."""
    parts = urlsplit(url)
    handshake = HANDSHAKE.format(path=f"{parts.path}?{parts.query}", host=parts.netloc).encode()
    record, turns, loop = IdleStreams(), asyncio.Semaphore(AT_ONCE), asyncio.get_running_loop()
    began: float | None = None

    async def connect() -> _IdleStream:
        while True:
            async with turns:
                try:
                    _, stream = await loop.create_connection(lambda: _IdleStream(handshake), parts.hostname, parts.port)
                    if await stream.opened:
                        return stream
                except OSError:
                    pass
            record.refused += 1
            await asyncio.sleep(RETRY)

    async def hold(stream: _IdleStream) -> None:
        while True:
            code = await stream.closed
            record.codes[code] = record.codes.get(code, 0) + 1
            record.closed.append(time.monotonic() - (began or time.monotonic()))
            stream = await connect()

    streams = await asyncio.gather(*(connect() for _ in range(number)))
    began = time.monotonic()
    stage.ready()
    holding = [asyncio.create_task(hold(stream)) for stream in streams]
    await stage.over()
    for task in holding:
        task.cancel()
    return record
