"""uvicorn's WebSocket protocol with a fast path: a message is answered within the call that received it.

uvicorn passes messages to the application through a queue, which costs more than an inference. Here complete frames are
cut from the received data; single-frame messages go directly to the message handler. Everything else (handshake,
control frames, fragments, protocol errors) goes to uvicorn's protocol, which uses the websockets library. Compression
is disabled: it would cost more than the rest. While a message is being answered or the client does not read, nothing is
read from the connection either, which gives backpressure.

Every frame counts: a turn of the event loop handles a limited number of frames of all connections together, and frames
that are no messages are admitted by the handler. A connection whose frame is refused is not read for a while.
"""

import asyncio
import struct
from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, cast

from uvicorn.config import Config
from uvicorn.protocols.websockets import auto
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.frames import Frame
from websockets.http11 import Request
from websockets.protocol import State
from websockets.speedups import apply_mask

from serve_app.runtime.timeouts import resume
from serve_app.runtime.uvicorn_http import MALFORMED

STREAM_PROTOCOL = "league.direct"
"""Name of the ASGI extension with the protocol of this connection, which takes a message handler."""
TEXT, BINARY = 0x81, 0x82
"""First byte of a single-frame message (RFC 6455, section 5.2)."""
DATA_FRAMES = (TEXT, BINARY)
MASKED = 0x80
"""Bit of the second byte; the other bits are the length, or 126 or 127 if it follows in 16 or 64 bits."""
LENGTH_16, LENGTH_64 = struct.Struct(">H"), struct.Struct(">Q")
CLOSE, PONG, CONTINUATION = 0x8, 0xA, 0x80
"""Operation codes, and the first byte of the last frame of a fragmented message."""
SWITCHING = 101
MAX_FRAMES_PER_TURN = 32
"""Frames of all connections that a turn of the event loop handles; the first of each connection is always handled."""
SHORTEST_PAUSE, LONGEST_PAUSE = 0.1, 1.0
"""Bounds of the seconds in which a connection is not read after a refusal. Shorter ones would cost as much as the
frames that they prevent; longer ones would delay answers to the pings of this server."""
CLOSE_TIMEOUT = 2.0
"""Seconds for a client to answer a close frame and read earlier messages."""
SERVICE_RESTART = 1012
TRY_AGAIN_LATER = 1013
TOO_BIG = 1009
MAX_REASON = 120
"""Characters of the reason in a close frame, which are ASCII."""
MAX_FRAGMENTS = 1024
"""Frames of a fragmented message: empty ones would take memory without being counted as bytes."""
SMALL = 4 * 1024
"""Bytes that a connection may hold in any case."""


class StreamMessage(NamedTuple):
    """A message of a stream."""

    data: bytes
    is_text: bool
    pause: float = 0.0
    """Seconds for which the client is asked to send nothing more, because its message was refused."""


class CloseStream(Exception):
    """Raised to close the stream with a WebSocket close code."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason


class Deferred(Protocol):
    """What a handler may await instead of a future: work that is cheaper together with that of other connections."""

    def now(self) -> Any:
        """Do the work at once, and return its outcome: an exception, or the value of the `await`."""

    def later(self, loop: asyncio.AbstractEventLoop, go_on: Callable[[Any], None]) -> None:
        """Do the work before the event loop polls again, and call `go_on` with the outcome."""


class MessageHandler(Protocol):
    """Answers the messages of a connection."""

    async def answer(self, data: bytes, is_text: bool) -> StreamMessage | None:
        """The answer to a message, if it has one. Awaits futures and `Deferred`. Raises CloseStream."""

    def admit_frame(self) -> float:
        """Count a control frame or a fragment. Returns 0, or the number of seconds until it may be handled."""

    def closing_message(self) -> StreamMessage | None:
        """The last message before the server closes the connection, or None."""


@dataclass(slots=True)
class SharedLimits:
    """What all connections of this process share."""

    max_incomplete: int
    incomplete: int = 0
    """Received bytes of messages that are not complete or not answered yet."""
    frames: int = 0
    """Frames that this turn of the event loop has handled."""

    def count_frame(self, loop: asyncio.AbstractEventLoop) -> None:
        """Count a frame of this turn."""
        if not self.frames:
            loop.call_soon(self._end_turn)
        self.frames += 1

    def _end_turn(self) -> None:
        self.frames = 0


def install(max_size: int, max_incomplete: int) -> None:
    """Make this the default WebSocket protocol of uvicorn servers in this process, including Ray Serve's.

    max_size: maximum size of a message in bytes. max_incomplete: of all incomplete messages together.
    """
    auto.AutoWebSocketsProtocol = partial(StreamWebSocketProtocol, max_size, SharedLimits(max_incomplete))


class StreamWebSocketProtocol(WebSocketsSansIOProtocol):
    """The WebSocket protocol of one connection."""

    def __init__(
        self,
        max_size: int,
        shared: SharedLimits,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        config.ws_max_size, config.ws_per_message_deflate = max_size, False
        super().__init__(config, server_state, app_state, _loop)
        self._max_size = max_size
        self._shared = shared
        self._held = 0
        """The part of `shared.incomplete` that this connection holds."""
        self._stream: MessageHandler | None = None
        self._pending = bytearray()
        """Received data that was not processed yet: a partial frame, or messages that wait."""
        self._is_busy = False
        """Whether a message is being answered, other connections have their turn, or the client must pause."""
        self._writes: list[bytes] = []

    def set_handler(self, stream: MessageHandler) -> None:
        """Pass messages to `stream` from now on."""
        self._stream = stream
        self._resume()

    def handle_connect(self, event: Request) -> None:
        """Offer this protocol to the application as an extension."""
        super().handle_connect(event)
        if self.response.status_code == SWITCHING:
            cast(dict[str, Any], self.scope["extensions"])[STREAM_PROTOCOL] = self

    def data_received(self, data: bytes) -> None:
        """Answer complete messages."""
        if not self.handshake_initiated:
            super().data_received(data)
            if self.conn.handshake_exc is not None and not self.handshake_initiated:
                # The library does not accept the request, such as one with a body.
                self.handshake_initiated = self.handshake_complete = self.close_sent = True
                self.transport.write(MALFORMED)
                self.transport.close()
        elif self.response.status_code != SWITCHING or self.initial_response is not None:  # refused
            super().data_received(data)
        elif self._pending or self._is_held:
            self._pending += data
            if not self._is_held:
                self._work(self._pending)
            elif self._stream is None:
                self.transport.pause_reading()  # until the handshake is complete: clients must not send before
        else:
            self._work(data)
        self._count_incomplete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Release what the connection holds."""
        super().connection_lost(exc)
        self._pending.clear()
        self.frames = []
        self._count_incomplete()

    def handle_cont(self, event: Frame) -> None:
        """Handle a further frame of a fragmented message."""
        super().handle_cont(event)
        if len(self.frames) > MAX_FRAGMENTS:
            self.end(TOO_BIG, f"a message has more than {MAX_FRAGMENTS} frames")

    def send_receive_event_to_app(self) -> None:
        """Answer a message that was fragmented, or that the library had to parse."""
        data, self.frames = b"".join(self.frames), []
        if not self.close_sent:
            self._handle_message(data, self.curr_msg_data_type == "text")

    def pause_writing(self) -> None:
        """The client does not read."""
        super().pause_writing()
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        """The client reads again."""
        super().resume_writing()
        self._resume()

    def handle_close(self, event: Frame) -> None:
        """Handle a close frame of the client."""
        super().handle_close(event)
        self._abort_later()

    def keepalive_timeout(self) -> None:
        """The client does not answer pings."""
        super().keepalive_timeout()
        self._abort_later()

    def handle_parser_exception(self) -> None:
        """Close after a protocol error or an oversized message, and wait for the client to disconnect."""
        if self.close_sent:
            return  # already closing
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
        """Send the client what it needs to continue on another replica, and close."""
        if self._stream is None or self.close_sent:
            super().shutdown()
        else:
            self.restart("the replica is shutting down: reconnect")

    def restart(self, reason: str) -> None:
        """Send the client what it needs to continue on another connection, and close."""
        if self._stream is not None and (last_message := self._stream.closing_message()) is not None:
            self._queue_frame(last_message)
        self.end(SERVICE_RESTART, reason)

    def end(self, code: int, reason: str) -> None:
        """Send a close frame, and wait for the client's."""
        reason = reason[:MAX_REASON]
        self._flush()
        if self.close_sent or self.transport.is_closing():
            return
        self.stop_keepalive()
        self.conn.send_close(code, reason)
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self._abort_later()
        self.queue.put_nowait({"type": "websocket.disconnect", "code": code, "reason": reason})

    @property
    def _is_held(self) -> bool:
        """Whether messages must wait."""
        return self._is_busy or self._stream is None or not self.writable.is_set()

    def _work(self, arrived: bytes | bytearray) -> None:
        """Answer the complete messages in `arrived`, and keep the rest."""
        at, is_first = 0, True
        while not self._is_held and (head := _parse_head(arrived, at)) is not None:
            size, length = head
            end = at + size + length
            if length > self._max_size:
                end = len(arrived)  # the header is enough for the library to refuse it
            elif end > len(arrived):
                break
            if not is_first and self._shared.frames >= MAX_FRAMES_PER_TURN:
                self._is_busy = True
                self.transport.pause_reading()
                self.loop.call_soon(self._go_on)
                break
            self._shared.count_frame(self.loop)
            is_first = False
            if (
                arrived[at] in DATA_FRAMES
                and arrived[at + 1] & MASKED
                and length <= self._max_size
                and self.conn.current_size is None  # no fragmented message is open
                and self.conn.state is State.OPEN
            ):
                start = at + size
                payload = apply_mask(bytes(arrived[start:end]), arrived[start - 4 : start])
                self._handle_message(payload, arrived[at] == TEXT, can_wait=end == len(arrived))
            elif wait := self._wait_for(arrived, at, at + size, end):
                self._pause(wait)
                break
            else:
                self._flush()
                super().data_received(bytes(arrived[at:end]))
            at = end
        self._flush()
        if arrived is self._pending:
            del self._pending[:at]
        else:
            self._pending += arrived[at:]

    def _wait_for(self, arrived: bytes | bytearray, at: int, payload: int, end: int) -> float:
        """Seconds until a frame that is no complete message may be handled. payload: where its payload begins."""
        assert self._stream is not None
        first = arrived[at]
        if first & 0xF == CLOSE or first == CONTINUATION:  # the handler counts the message that is complete now
            return 0.0
        if first & 0xF == PONG and arrived[at + 1] & MASKED and self.pending_ping_payload is not None:
            pong = apply_mask(bytes(arrived[payload:end]), bytes(arrived[payload - 4 : payload]))
            if pong == self.pending_ping_payload:
                return 0.0
        return self._stream.admit_frame()

    def _handle_message(self, data: bytes, is_text: bool, can_wait: bool = False) -> None:
        """Answer a message, synchronously if the handler does not suspend.

        can_wait: whether the answer can be deferred; with messages that have arrived already, it is sent in one write.
        """
        assert self._stream is not None
        self._advance(self._stream.answer(data, is_text).__await__(), None, can_wait)

    def _advance(self, steps: Generator[Any, Any, StreamMessage | None], outcome: Any, can_wait: bool = False) -> None:
        """Continue a handler with the value or the exception that it awaits."""
        try:
            waits_for = steps.throw(outcome) if isinstance(outcome, Exception) else steps.send(outcome)
        except StopIteration as done:
            self._queue_frame(done.value)
            if done.value is not None and done.value.pause:
                self._pause(done.value.pause)
        except CloseStream as end:
            self.end(end.code, end.reason)
        else:
            if asyncio.isfuture(waits_for) or waits_for is None:
                self._is_busy = True
                self.transport.pause_reading()
                task = self.loop.create_task(self._finish(steps, waits_for))
                task.add_done_callback(self.on_task_complete)
                self.tasks.add(task)
            elif can_wait:
                self._is_busy = True  # nothing is read before the outcome is there
                waits_for.later(self.loop, partial(self._end_wait, steps))
            else:
                self._advance(steps, waits_for.now())

    def _end_wait(self, steps: Generator[Any, Any, StreamMessage | None], outcome: Any) -> None:
        self._is_busy = False
        self._advance(steps, outcome)
        if self._is_held:
            self._flush()
        else:
            self._resume()

    async def _finish(self, steps: Generator[Any, Any, StreamMessage | None], waits_for: Any) -> None:
        try:
            self._queue_frame(answer := await resume(steps, waits_for))
        except CloseStream as end:
            self.end(end.code, end.reason)
        else:
            if answer is not None and answer.pause:
                self._flush()
                self._pause(answer.pause)
                return
        self._go_on()

    def _pause(self, seconds: float) -> None:
        """Read nothing from the client for a while: it has sent more than it may."""
        self._is_busy = True
        self.transport.pause_reading()
        self.loop.call_later(min(max(seconds, SHORTEST_PAUSE), LONGEST_PAUSE), self._go_on)

    def _go_on(self) -> None:
        self._is_busy = False
        self._resume()

    def _count_incomplete(self) -> None:
        """Close the connection if incomplete messages take too much memory and it holds more than a small part."""
        held = len(self._pending) + sum(map(len, self.frames))
        if held == self._held:
            return
        self._shared.incomplete += held - self._held
        self._held = held
        if held > SMALL and self._shared.incomplete > self._shared.max_incomplete:
            self.frames = []
            self._pending.clear()
            self.end(TRY_AGAIN_LATER, "incomplete messages take too much memory in this replica")
            self._count_incomplete()

    def _resume(self) -> None:
        """Answer pending messages, then resume reading."""
        if self.transport.is_closing():
            return
        self._work(self._pending)
        self._count_incomplete()
        if not self._is_held:
            self.transport.resume_reading()

    def _queue_frame(self, message: StreamMessage | None) -> None:
        if message is not None and not self.close_sent:
            self._writes.append(_encode_frame(message))

    def _flush(self) -> None:
        if self._writes:
            self.transport.write(b"".join(self._writes))
            self._writes.clear()

    def _abort_later(self) -> None:
        """Abort the connection after a timeout. Aborting at once could lose messages that the client has not read, and
        waiting for it to read them could take forever.
        """
        if self.close_timer is None and not self.disconnected:
            self.close_timer = self.loop.call_later(CLOSE_TIMEOUT, self.transport.abort)


def _parse_head(data: bytes | bytearray, at: int) -> tuple[int, int] | None:
    """Sizes of the header and the payload of the frame at `at`; None if the header is incomplete."""
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


def _encode_frame(message: StreamMessage) -> bytes:
    """A message as one unmasked frame."""
    data, is_text, _ = message
    opcode, length = TEXT if is_text else BINARY, len(data)
    if length < 126:
        return bytes((opcode, length)) + data
    if length < 2**16:
        return bytes((opcode, 126)) + LENGTH_16.pack(length) + data
    return bytes((opcode, 127)) + LENGTH_64.pack(length) + data
