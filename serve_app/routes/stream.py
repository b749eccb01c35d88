"""The WebSocket /v1/policies/{model}/stream: one message per tick, for game servers and robots.

?version=N      pinned for its life to that version, or to the one that an alias (by default champion) names now
?follow=ALIAS   each message is answered by the version that the alias names then

Behind uvicorn, messages go from the socket to the stream and back within one call (websocket_protocol.py); another
ASGI server is asked for one message after the other.
"""

from starlette.types import Receive, Scope, Send

from league.errors import InvalidInput, Overloaded
from league.refs import CHAMPION, check_alias
from serve_app.doors import KEY
from serve_app.routes.action import REPLICA, query
from serve_app.streams import Stream, StreamEnds, StreamParts
from serve_app.websocket_protocol import DIRECT

TOO_BIG = 1009


class StreamRoute:
    """The endpoint, an ASGI application of its own."""

    def __init__(self, parts: StreamParts, replica: str) -> None:
        self._parts = parts
        self._replica = replica
        self.open = 0
        """Streams that are open."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Hold a stream until it ends. Raises LeagueError before it is accepted."""
        await receive()  # the handshake
        if self.open >= self._parts.settings.max_streams:
            raise Overloaded(f"{self.open} streams are open here already")
        self.open += 1
        try:
            stream, headers = await self._begun(scope)
            await send({"type": "websocket.accept", "headers": headers})
            await self._converse(stream, scope, receive, send)
        finally:
            self.open -= 1

    async def _begun(self, scope: Scope) -> tuple[Stream, list[tuple[bytes, bytes]]]:
        model, asked = scope["path_params"]["model"], query(scope)
        follows = asked.get("follow")
        if follows is not None:
            check_alias(follows)
            if "version" in asked:
                raise InvalidInput("version and follow contradict each other: a stream stays, or follows")
        version, policy = await self._parts.models.find(
            model, follows or asked.get("version", CHAMPION), scope["headers"]
        )
        headers = {b"x-league-version": str(version.number), b"x-league-sha256": version.sha256, REPLICA: self._replica}
        stream = Stream(self._parts, model, (version, policy), follows, scope["headers"], scope.get(KEY))
        return stream, [(name, value.encode()) for name, value in headers.items()]

    async def _converse(self, stream: Stream, scope: Scope, receive: Receive, send: Send) -> None:
        if (direct := scope.get("extensions", {}).get(DIRECT)) is not None:
            direct.converse(stream)
        while (message := await receive())["type"] == "websocket.receive":
            text = message.get("text")
            data = message["bytes"] if text is None else text.encode()
            try:
                if len(data) > self._parts.settings.max_body:
                    raise StreamEnds(TOO_BIG, f"a message is larger than {self._parts.settings.max_body} bytes")
                answer = await stream.answer(data, text is not None)
            except StreamEnds as end:
                await send({"type": "websocket.close", "code": end.code, "reason": end.reason})
                return
            key, value = ("text", answer.data.decode()) if answer.is_text else ("bytes", answer.data)
            await send({"type": "websocket.send", key: value})
