"""A transport that sends the head and the body of a response together.

uvicorn writes them separately, and both uvloop and asyncio send each write at once: two system calls here, and two
wake-ups of HAProxy or the client, which cost more than computing a small policy.
"""

import asyncio
from collections.abc import Callable

MAX_HELD = 65_536
"""Bytes that are held at most, so that a response of many parts is subject to the transport's flow control."""


class JoinedWrites:
    """Holds what is written until `flush`, `close` or the next turn of the event loop, and sends it as one write."""

    __slots__ = ("_call_soon", "_held", "_size", "transport")

    def __init__(self, transport: asyncio.Transport, call_soon: Callable[[Callable[[], None]], object]) -> None:
        self.transport = transport
        self._call_soon = call_soon
        self._held: list[bytes] = []
        self._size = 0

    def write(self, data: bytes) -> None:
        """Hold or send bytes, in order."""
        if not self._held:
            self._call_soon(self.flush)
        self._held.append(data)
        self._size += len(data)
        if self._size >= MAX_HELD:
            self.flush()

    def flush(self) -> None:
        """Send what is held; if the connection is closed, drop it."""
        if not self._held:
            return
        held, self._held, self._size = self._held, [], 0
        if not self.transport.is_closing():
            self.transport.write(held[0] if len(held) == 1 else b"".join(held))

    def close(self) -> None:
        """Send what is held, and close the connection."""
        self.flush()
        self.transport.close()

    def is_closing(self) -> bool:
        """Whether the connection is closed or being closed."""
        return self.transport.is_closing()
