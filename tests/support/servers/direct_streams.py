"""Streams for a TestClient: what serve_app.runtime.uvicorn_websocket does for the application on uvicorn."""

import asyncio
from contextlib import suppress

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from serve_app.runtime.uvicorn_websocket import SERVICE_RESTART, STREAM_PROTOCOL, CloseStream, MessageHandler


class DirectStreams:
    """An application whose WebSockets have a protocol that takes a message handler."""

    def __init__(self, application: ASGIApp) -> None:
        self._application = application

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            connection = _Connection(receive, send)
            scope["extensions"][STREAM_PROTOCOL] = connection
            await self._application(scope, connection.receive, send)
        else:
            await self._application(scope, receive, send)


class _Connection:
    def __init__(self, receive: Receive, send: Send) -> None:
        self._receive = receive
        self._send = send
        self._handler: MessageHandler | None = None
        self._end: asyncio.Future[CloseStream] = asyncio.get_running_loop().create_future()

    def set_handler(self, handler: MessageHandler) -> None:
        """Pass messages to `handler` from now on."""
        self._handler = handler

    def end(self, code: int, reason: str) -> None:
        """Close the connection."""
        if not self._end.done():
            self._end.set_result(CloseStream(code, reason))

    def restart(self, reason: str) -> None:
        """Close the connection so that the client connects again."""
        self.end(SERVICE_RESTART, reason)

    async def receive(self) -> Message:
        """The next message that is not for the handler."""
        while self._handler is None:
            return await self._receive()
        arriving = asyncio.ensure_future(self._answer_all(self._handler))
        await asyncio.wait((arriving, self._end), return_when=asyncio.FIRST_COMPLETED)
        if arriving.done():
            return arriving.result()
        arriving.cancel()
        with suppress(asyncio.CancelledError):
            await arriving
        end = self._end.result()
        await self._send({"type": "websocket.close", "code": end.code, "reason": end.reason})
        return {"type": "websocket.disconnect", "code": end.code, "reason": end.reason}

    async def _answer_all(self, handler: MessageHandler) -> Message:
        while (message := await self._receive())["type"] == "websocket.receive":
            text = message.get("text")
            try:
                answer = await handler.answer(message["bytes"] if text is None else text.encode(), text is not None)
            except CloseStream as end:
                self.end(end.code, end.reason)
                await asyncio.Event().wait()
            if answer is not None:
                key, value = ("text", answer.data.decode()) if answer.is_text else ("bytes", answer.data)
                await self._send({"type": "websocket.send", key: value})
        return message
