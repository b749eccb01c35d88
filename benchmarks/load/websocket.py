"""A lightweight WebSocket load generator: raw sockets, one message in flight per stream.

Frames are masked with zeros, which RFC 6455 allows and which costs the client nothing; the server must unmask them
nevertheless.
"""

import asyncio
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast
from urllib.parse import urlsplit

import numpy as np

from benchmarks.load.elsewhere import run_elsewhere

TEXT, BINARY = 1, 2
FINAL, MASKED = 0x80, 0x80
NO_MASK = bytes(4)
HANDSHAKE = (
    "GET {path} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


@dataclass(frozen=True, slots=True)
class StreamLoad:
    """The results of one run. Latencies in milliseconds; `failures` counts answers of another kind than the message."""

    messages: int
    seconds: float
    failures: int
    p50: float
    p99: float

    @property
    def rate(self) -> float:
        """Answers per second."""
        return (self.messages - self.failures) / self.seconds


class StreamConnection(asyncio.Protocol):
    """Sends `frame` again as soon as its answer is complete; `on_answer` takes the opcode and the time of sending."""

    def __init__(self, handshake: bytes, frame: bytes, on_answer: Callable[[int, float], bool]) -> None:
        self.handshake = handshake
        self.frame = frame
        self.on_answer = on_answer
        self.closed = asyncio.get_running_loop().create_future()
        self.received = b""
        self.is_open = False
        self.sent_at = 0.0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self.transport.write(self.handshake)

    def data_received(self, data: bytes) -> None:
        self.received = self.received + data if self.received else data
        if not self.is_open:
            end = self.received.find(b"\r\n\r\n")
            if end < 0:
                return
            if not self.received.startswith(b"HTTP/1.1 101"):
                raise RuntimeError(self.received[:300].decode("latin-1"))
            self.is_open, self.received = True, self.received[end + 4 :]
            self.send()
            return
        size = frame_length(self.received)
        if size is None or len(self.received) < size:
            return
        opcode, self.received = self.received[0] & 0x0F, self.received[size:]
        if opcode not in (TEXT, BINARY):
            return  # a short run need not answer pings
        if self.on_answer(opcode, self.sent_at):
            self.send()
        else:
            self.transport.close()

    def send(self) -> None:
        self.sent_at = time.perf_counter()
        self.transport.write(self.frame)

    def connection_lost(self, error: Exception | None) -> None:
        self.closed.set_result(error)


def frame_length(data: bytes) -> int | None:
    """Length of the frame at the start of `data`; None if its header has not arrived."""
    if len(data) < 2:
        return None
    length = data[1] & 0x7F
    if length < 126:
        return 2 + length
    form, head = (">H", 4) if length == 126 else (">Q", 10)
    return None if len(data) < head else head + int(struct.unpack_from(form, data, 2)[0])


def frame_of(message: bytes, opcode: int) -> bytes:
    """A message as a client frame."""
    head = bytes([FINAL | opcode])
    if len(message) < 126:
        head += bytes([MASKED | len(message)])
    elif len(message) < 2**16:
        head += bytes([MASKED | 126]) + struct.pack(">H", len(message))
    else:
        head += bytes([MASKED | 127]) + struct.pack(">Q", len(message))
    return head + NO_MASK + message


async def run(url: str, message: bytes, is_text: bool, streams: int, seconds: float, warm_up: float) -> StreamLoad:
    """Load `url` for `warm_up + seconds`; the warm-up is not counted. A stream that ends early is an error."""
    parts = urlsplit(url)
    handshake = HANDSHAKE.format(path=f"{parts.path}?{parts.query}", host=parts.netloc).encode()
    opcode = TEXT if is_text else BINARY
    frame, latencies, failures = frame_of(message, opcode), list[float](), 0
    start = time.perf_counter() + warm_up
    stop = start + seconds

    def on_answer(answered: int, sent_at: float) -> bool:
        nonlocal failures
        answered_at = time.perf_counter()
        if start <= answered_at <= stop:
            latencies.append(answered_at - sent_at)
            failures += answered != opcode
        return answered_at < stop

    loop = asyncio.get_running_loop()
    connections = [
        (
            await loop.create_connection(
                lambda: StreamConnection(handshake, frame, on_answer), parts.hostname, parts.port
            )
        )[1]
        for _ in range(streams)
    ]
    await asyncio.gather(*(connection.closed for connection in connections))
    if time.perf_counter() < stop:
        raise RuntimeError("the server ended the streams")
    p50, p99 = np.percentile(np.array(latencies or [np.nan]) * 1e3, [50, 99])
    return StreamLoad(len(latencies), seconds, failures, float(p50), float(p99))


def measure(
    url: str, message: bytes, *, is_text: bool, streams: int, seconds: float, warm_up: float = 1.0
) -> StreamLoad:
    """Run the generator in a process of its own."""
    return run_elsewhere(run, url, message, is_text, streams, seconds, warm_up)
