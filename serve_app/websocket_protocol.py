"""uvicorn's WebSockets, with a short way for messages: from the socket to a stream and back within one call.

uvicorn hands a message to the application through a queue, and stops reading until it was taken: a wake-up of a task
and two changes of what is listened to for each message, which cost more than an action. Here whole frames are cut out
of what arrives; messages of one frame go straight to the stream, and anything else (the handshake, control frames,
fragments, faults) to uvicorn's protocol, which hands it to the library.

Nothing is compressed: a frame is small, and its compression would cost more than the rest. A stream that computes, or
whose client does not read, is not read from either: what it sends stays with it.
"""

import asyncio
import struct
from collections.abc import Generator
from functools import partial
from typing import Any, cast

from uvicorn.config import Config
from uvicorn.protocols.websockets import auto
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.frames import Frame
from websockets.http11 import Request
from websockets.protocol import State
from websockets.speedups import apply_mask

from serve_app.deadlines import continued
from serve_app.streams import Message, Stream, StreamEnds

DIRECT = "league.direct"
"""ASGI extension: the protocol of this connection, which takes a stream."""
TEXT, BINARY = 0x81, 0x82
"""The first byte of a message in one frame (RFC 6455, section 5.2)."""
WHOLE = (TEXT, BINARY)
MASKED = 0x80
"""Of the second byte, whose rest is the length, or 126 or 127 if that follows in 16 or 64 bits."""
LENGTH_16, LENGTH_64 = struct.Struct(">H"), struct.Struct(">Q")
SWITCHING = 101
AT_ONCE = 16
"""Messages of one connection that are answered before others have their turn."""
CLOSE_TIMEOUT = 2.0
"""Seconds that a client has to answer a close, and to read what was said before."""
RESTARTS = 1012


def install(max_size: int) -> None:
    """Make this the protocol of uvicorn servers that are told nothing else, as Ray Serve's are.

    max_size: of a message, in bytes.
    """
    auto.AutoWebSocketsProtocol = partial(StreamProtocol, max_size)


class StreamProtocol(WebSocketsSansIOProtocol):
    """The WebSocket of one connection."""

    def __init__(
        self,
        max_size: int,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        config.ws_max_size, config.ws_per_message_deflate = max_size, False
        super().__init__(config, server_state, app_state, _loop)
        self._max_size = max_size
        self._stream: Stream | None = None
        self._pending = bytearray()
        """What has arrived and was not looked at yet: part of a frame, or what waits its turn."""
        self._is_busy = False
        """Whether a message is being answered that takes longer, or others have their turn."""
        self._writes: list[bytes] = []

    def converse(self, stream: Stream) -> None:
        """Let messages from now on go to `stream`."""
        self._stream = stream
        self._go_on()

    def handle_connect(self, event: Request) -> None:
        """Offer this protocol to the application."""
        super().handle_connect(event)
        if self.response.status_code == SWITCHING:
            cast(dict[str, Any], self.scope["extensions"])[DIRECT] = self

    def data_received(self, data: bytes) -> None:
        """Answer the messages that are whole."""
        if not self.handshake_initiated or not self._may_converse:
            super().data_received(data)
        elif self._pending or self._is_held:
            self._pending += data
            if not self._is_held:
                self._work(self._pending)
            elif self._stream is None:
                self.transport.pause_reading()  # until it is accepted: a client must not send before
        else:
            self._work(data)

    def send_receive_event_to_app(self) -> None:
        """A message that came in fragments, or as the library alone can read it, is whole."""
        data, self.frames = b"".join(self.frames), []
        if not self.close_sent:
            self._take(data, self.curr_msg_data_type == "text")

    def pause_writing(self) -> None:
        """The client does not read."""
        super().pause_writing()
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        """The client reads again."""
        super().resume_writing()
        self._go_on()

    def handle_close(self, event: Frame) -> None:
        """The client ends the stream, or agrees to its end."""
        super().handle_close(event)
        self._abort_later()

    def keepalive_timeout(self) -> None:
        """The client does not answer."""
        super().keepalive_timeout()
        self._abort_later()

    def handle_parser_exception(self) -> None:
        """The client breaks the protocol, or sends too much: say so, and wait until it hangs up."""
        if self.close_sent:
            return  # more of the same
        self.stop_keepalive()
        close = self.conn.close_sent
        assert close is not None
        self.transport.write(b"".join(self.conn.data_to_send()))
        if self.transport.can_write_eof():  # not over TLS
            self.transport.write_eof()
        self.close_sent = True
        self._abort_later()
        self.queue.put_nowait({"type": "websocket.disconnect", "code": close.code, "reason": close.reason})

    def shutdown(self) -> None:
        """The server stops: give the client what it needs to go on elsewhere."""
        if self._stream is None or self.close_sent:
            super().shutdown()
            return
        if (farewell := self._stream.farewell()) is not None:
            self._say(farewell)
        self._end(RESTARTS, "the replica drains: connect again")

    @property
    def _may_converse(self) -> bool:
        """Whether the handshake leads, or has led, to a stream."""
        return self.response.status_code == SWITCHING and self.initial_response is None

    @property
    def _is_held(self) -> bool:
        """Whether messages have to wait."""
        return self._is_busy or self._stream is None or not self.writable.is_set()

    def _work(self, arrived: bytes | bytearray) -> None:
        """Answer the whole messages of `arrived`, and keep the rest."""
        at, messages = 0, 0
        while not self._is_held and (head := _head(arrived, at)) is not None:
            size, length = head
            end = at + size + length
            if length > self._max_size:
                end = len(arrived)  # its head is enough for the library to refuse it
            elif end > len(arrived):
                break
            if messages == AT_ONCE:
                self._let_others()
                break
            if arrived[at] in WHOLE and arrived[at + 1] & MASKED and length <= self._max_size and self._is_between:
                start = at + size
                self._take(apply_mask(bytes(arrived[start:end]), arrived[start - 4 : start]), arrived[at] == TEXT)
                messages += 1
            else:
                self._flush()
                super().data_received(bytes(arrived[at:end]))
            at = end
        self._flush()
        if arrived is self._pending:
            del self._pending[:at]
        else:
            self._pending += arrived[at:]

    @property
    def _is_between(self) -> bool:
        """Whether a message may begin here: no fragments of another are there, and no end was said."""
        return self.conn.current_size is None and self.conn.state is State.OPEN

    def _take(self, data: bytes, is_text: bool) -> None:
        """Answer a message: now, if nothing must be waited for."""
        assert self._stream is not None
        steps = self._stream.answer(data, is_text).__await__()
        try:
            waits_for = steps.send(None)
        except StopIteration as done:
            self._say(done.value)
        except StreamEnds as end:
            self._end(end.code, end.reason)
        else:
            self._is_busy = True
            self.transport.pause_reading()
            task = self.loop.create_task(self._finish(steps, waits_for))
            task.add_done_callback(self.on_task_complete)
            self.tasks.add(task)

    async def _finish(self, steps: Generator[Any, Any, Message], waits_for: Any) -> None:
        try:
            self._say(await continued(steps, waits_for))
        except StreamEnds as end:
            self._end(end.code, end.reason)
        self._go_on_after()

    def _let_others(self) -> None:
        self._is_busy = True
        self.transport.pause_reading()
        self.loop.call_soon(self._go_on_after)

    def _go_on_after(self) -> None:
        self._is_busy = False
        self._go_on()

    def _go_on(self) -> None:
        """Answer what waits, then read on."""
        if self.transport.is_closing():
            return
        self._work(self._pending)
        if not self._is_held:
            self.transport.resume_reading()

    def _say(self, message: Message) -> None:
        if not self.close_sent:
            self._writes.append(_frame(message))

    def _flush(self) -> None:
        if self._writes:
            self.transport.write(b"".join(self._writes))
            self._writes.clear()

    def _end(self, code: int, reason: str) -> None:
        """Say that this is the end, and wait until the client says so, too."""
        self._flush()
        if self.close_sent or self.transport.is_closing():
            return
        self.stop_keepalive()
        self.conn.send_close(code, reason)
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self._abort_later()
        self.queue.put_nowait({"type": "websocket.disconnect", "code": code, "reason": reason})

    def _abort_later(self) -> None:
        """Hang up soon. At once would cost the client the last words if something of it is still unread here, and to
        wait until it has read them all might be for ever."""
        if self.close_timer is None and not self.disconnected:
            self.close_timer = self.loop.call_later(CLOSE_TIMEOUT, self.transport.abort)


def _head(data: bytes | bytearray, at: int) -> tuple[int, int] | None:
    """Bytes of the head of the frame at `at`, and of its payload; None if the head is not all there."""
    there = len(data) - at
    if there < 2:
        return None
    length, mask = data[at + 1] & 0x7F, 4 if data[at + 1] & MASKED else 0
    if length < 126:
        return 2 + mask, length
    long = LENGTH_16 if length == 126 else LENGTH_64
    if there < 2 + long.size:
        return None
    return 2 + long.size + mask, long.unpack_from(data, at + 2)[0]


def _frame(message: Message) -> bytes:
    """A message in one frame, unmasked as a server's are."""
    data, is_text = message
    opcode, length = TEXT if is_text else BINARY, len(data)
    if length < 126:
        return bytes((opcode, length)) + data
    if length < 2**16:
        return bytes((opcode, 126)) + LENGTH_16.pack(length) + data
    return bytes((opcode, 127)) + LENGTH_64.pack(length) + data
