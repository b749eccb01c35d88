"""Relays the messages of a simulator to a gateway, and back: the WebSockets of both sides.

Messages are passed on unread. The simulator's connection is uvicorn's (uvicorn_websocket.py).
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import NamedTuple

from starlette.types import Receive, Scope, Send
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException

from league.errors import one_line
from league.registry.storage.rows import Gateway
from serve_app.runtime.ray_serve import logger
from serve_app.runtime.uvicorn_websocket import STREAM_PROTOCOL, StreamWebSocketProtocol

OPEN_SECONDS, CLOSE_SECONDS = 5.0, 1.0
QUEUED = 2
"""Messages of a simulator that wait for the gateway."""
LOST = 1011
UNSENDABLE = (1005, 1006, 1015)
"""Close codes that are no part of a close frame (RFC 6455, section 7.4.1)."""


class CloseFrame(NamedTuple):
    """How a connection is closed."""

    code: int
    reason: str


async def connected(gateway: Gateway) -> ClientConnection | None:
    """Connect to a gateway; None if it cannot be reached."""
    try:
        return await connect(
            f"ws{gateway.url.removeprefix('http')}/v1/leagues/{gateway.league}/simulate",
            additional_headers={"authorization": f"Bearer {gateway.token}"},
            compression=None,
            max_size=None,
            open_timeout=OPEN_SECONDS,
            close_timeout=CLOSE_SECONDS,
            proxy=None,
        )
    except (OSError, WebSocketException) as error:
        logger.warning("a gateway of league %s cannot be reached: %s", gateway.league, one_line(error, with_type=True))
        return None


async def relay(
    scope: Scope,
    receive: Receive,
    send: Send,
    gateway: ClientConnection,
    until: Awaitable[CloseFrame],
    admit_frame: Callable[[], float],
) -> None:
    """Pass messages on until one side closes, or `until` says how to close. admit_frame: see MessageHandler."""
    messages = _Messages(admit_frame)
    ends = [asyncio.ensure_future(work) for work in (_downwards(send, gateway), until)]
    # The simulator's connection passes on that it was closed, and nothing else.
    tasks = [*ends, asyncio.ensure_future(receive()), asyncio.create_task(messages.pass_on(gateway))]
    connection: StreamWebSocketProtocol = scope["extensions"][STREAM_PROTOCOL]
    connection.set_handler(messages)
    try:
        ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        close = next((task.result() for task in ends if task in ended), None)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    if close is not None:
        with suppress(Exception):  # the simulator may have gone at the same time
            await send({"type": "websocket.close", "code": close.code, "reason": close.reason})


async def _downwards(send: Send, gateway: ClientConnection) -> CloseFrame:
    """Pass on what the gateway sends. Returns how to close."""
    try:
        while True:
            message = await gateway.recv()
            await send({"type": "websocket.send", "text" if isinstance(message, str) else "bytes": message})
    except ConnectionClosed as closed:
        frame = closed.rcvd
        if frame is None or frame.code in UNSENDABLE:
            return CloseFrame(LOST, "the process that needed episodes has ended: connect again")
        return CloseFrame(frame.code, frame.reason)


class _Messages:
    """Takes the messages of a simulator from its connection, a few at a time."""

    def __init__(self, admit_frame: Callable[[], float]) -> None:
        self.admit_frame = admit_frame
        self._queue: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue(QUEUED)

    async def answer(self, data: bytes, is_text: bool) -> None:
        """Wait until there is room for the message."""
        await self._queue.put((data, is_text))

    def closing_message(self) -> None:
        """There is nothing to continue with."""

    async def pass_on(self, gateway: ClientConnection) -> None:
        """Send the messages to the gateway, or drop them once it has closed."""
        while True:
            data, is_text = await self._queue.get()
            with suppress(ConnectionClosed):
                await gateway.send(data, text=is_text)
