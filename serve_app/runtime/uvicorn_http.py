"""uvicorn's HTTP protocol with batched accepts, notification of shutdown, and limits for idle connections.

uvloop accepts one connection per turn of the event loop, and a turn handles the requests of all open connections. If
many clients connect at once with slow requests, the last one would wait for a long time. Therefore each new
connection accepts all others that wait.

HAProxy limits the connections of its clients. Clients that connect to the port of a replica have a limit per address,
and must send a request soon. While many connections are open, each of them is closed after its response.

A server that stops finishes requests in progress. Event streams are notified so that they end.

Requests that PlainRequests takes, and that arrive in one piece, are answered without a task and an ASGI application.
"""

import asyncio
import logging
import os
import resource
import socket
import stat
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, partial
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Protocol, cast
from weakref import WeakKeyDictionary

from uvicorn.config import Config
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware
from uvicorn.protocols.http import auto
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol
from uvicorn.server import ServerState

OF_ONE_ADDRESS, CROWDED = 1 / 8, 1 / 4
"""Shares of the file descriptors of this process: connections of one address of another machine, and open connections
from which on each is closed after its response."""
FIRST_REQUEST = 10.0
"""Seconds in which the head of the first request must arrive."""


class AcceptQueue:
    """The accept queue of the socket of this process that listens on a port; always empty if there is none."""

    __slots__ = ("_listener",)

    def __init__(self, port: int) -> None:
        self._listener = _listener(port)

    def __del__(self) -> None:
        if self._listener is not None:
            self._listener.detach()

    def take(self) -> socket.socket | None:
        """Accept the next connection without blocking; None if there is none."""
        if self._listener is None:
            return None
        try:
            connection, _ = self._listener.accept()
        except OSError:  # none waits, or no longer listening
            return None
        connection.setblocking(False)
        return connection


def _listener(port: int) -> socket.socket | None:
    """The socket itself. A duplicate would keep listening after its owner has closed it."""
    with suppress(OSError):  # no /proc: not Linux
        for entry in Path("/proc/self/fd").iterdir():
            with suppress(OSError):
                if stat.S_ISSOCK(entry.stat().st_mode) and _listens(int(entry.name), port):
                    return socket.socket(fileno=int(entry.name))
    return None


def _listens(number: int, port: int) -> bool:
    with socket.socket(fileno=os.dup(number)) as copy:
        is_tcp = copy.family in (socket.AF_INET, socket.AF_INET6) and copy.type == socket.SOCK_STREAM
        return (
            is_tcp and copy.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) == 1 and copy.getsockname()[1] == port
        )


_queues: "WeakKeyDictionary[ServerState, AcceptQueue]" = WeakKeyDictionary()
"""Accept queue of each server of this process."""
_addresses: "WeakKeyDictionary[ServerState, Counter[str]]" = WeakKeyDictionary()
"""Open connections of each address of another machine, for each server of this process."""


def _descriptors(share: float) -> float:
    """A share of the file descriptors that this process may have."""
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return float("inf") if descriptors == resource.RLIM_INFINITY else share * descriptors


@lru_cache(maxsize=64)
def _is_loopback(address: str) -> bool:
    return ip_address(address).is_loopback


@lru_cache(maxsize=1024)
def header_lines(headers: tuple[tuple[bytes, bytes], ...]) -> bytes:
    """Headers as lines of a response. The same few recur."""
    return b"".join(b"%b: %b\r\n" % header for header in headers)


NO_SNIFFING = (b"x-content-type-options", b"nosniff")
"""Header of every response: browsers must not guess another type than the declared one. uvicorn does not add it where a
WebSocket handshake is refused, which browsers show to no page."""
NO_HTTP = b'{"code": "invalid_input", "message": "the request is not valid HTTP"}'
MALFORMED = (
    b"HTTP/1.1 400 Bad Request\r\ncontent-type: application/json\r\nx-content-type-options: nosniff\r\n"
    b"connection: close\r\ncontent-length: %d\r\n\r\n%b" % (len(NO_HTTP), NO_HTTP)
)
"""The response to bytes that are not HTTP."""


class PlainRequests(Protocol):
    """What answers simple requests, all of those that arrive in one turn of the event loop together."""

    def takes(self, url: bytes, headers: list[tuple[bytes, bytes]]) -> bool:
        """Whether it may answer a POST with these headers. Called before the body arrives."""

    def add(self, connection: "HttpProtocol") -> None:
        """Answer the request of a connection in this turn or a later one: call its `answer` or `pass_on`."""

    def flush(self) -> None:
        """Answer all added requests now."""


def install(when_stopping: Callable[[], None], plain: PlainRequests | None = None) -> None:
    """Make this the default HTTP protocol of uvicorn servers in this process, including Ray Serve's.

    when_stopping: called for each open connection when the server stops. plain: answers simple requests.
    """
    auto.AutoHTTPProtocol = partial(HttpProtocol, when_stopping, plain)  # type: ignore[assignment]


class HttpProtocol(HttpToolsProtocol):
    """The protocol of one connection."""

    def __init__(
        self,
        when_stopping: Callable[[], None],
        plain: PlainRequests | None,
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        if isinstance(self.app, ProxyHeadersMiddleware):  # nothing reads the address and scheme that it sets
            self.app = self.app.app
        # The server copies those of its configuration every second.
        for headers in (config.encoded_headers, server_state.default_headers):
            if NO_SNIFFING not in headers:
                headers.append(NO_SNIFFING)
        self._when_stopping = when_stopping
        # The general path sends 503 beyond `limit_concurrency`, and writes uvicorn's access log.
        is_logged = self.access_log and self.access_logger.isEnabledFor(logging.INFO)
        self._plain = None if is_logged or self.root_path or self.limit_concurrency is not None else plain
        self._is_held = False
        """Whether the body of a plain request is arriving."""
        self.is_waiting = False
        """Whether a plain request is to be answered."""
        self.body = b""
        """That of a plain request."""
        self._address = ""
        """The address of a client on another machine, as long as its connection counts."""
        self._first_request: asyncio.TimerHandle | None = None
        self._crowd = _descriptors(CROWDED)

    def shutdown(self) -> None:
        """Finish the request in progress."""
        self._flush_plain()
        super().shutdown()
        self._when_stopping()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Start this connection, and accept those that wait."""
        super().connection_made(cast(asyncio.Transport, transport))
        if not self._is_admitted():
            self.transport.abort()
            return
        self._first_request = self.loop.call_later(FIRST_REQUEST, self.transport.close)
        if self.server is None or self.server[1] is None:
            return
        queue = _queues.get(self.server_state)
        if queue is None:
            queue = _queues[self.server_state] = AcceptQueue(self.server[1])
        while (connection := queue.take()) is not None:
            protocol = partial(
                HttpProtocol,
                self._when_stopping,
                self._plain,
                self.config,
                self.server_state,
                self.app_state,
                self.loop,
            )
            task = self.loop.create_task(self.loop.connect_accepted_socket(protocol, connection))
            self.server_state.tasks.add(task)  # type: ignore[arg-type]
            task.add_done_callback(self.server_state.tasks.discard)

    def connection_lost(self, exc: Exception | None) -> None:
        """Count the connection no longer, and forget it.

        uvicorn keeps a connection that the client has reset until its keep-alive time has passed: 9 kB for 75 s.
        """
        super().connection_lost(exc)
        self._unset_keepalive_if_required()
        self._release()

    def data_received(self, data: bytes) -> None:
        """Parse bytes of requests."""
        super().data_received(data)
        if self._is_held:  # the rest of the body arrives later
            self._is_held = False
            if not self.transport.is_closing():
                self._start()

    def on_message_begin(self) -> None:
        """Prepare for a request."""
        self._flush_plain()  # a pipelined request is answered after the one before
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """Start the request, or hold it until its body is complete."""
        if self._first_request is not None:
            self._first_request.cancel()
            self._first_request = None
        if (
            self._plain is not None
            and self.parser.get_method() == b"POST"
            and self._plain.takes(self.url, self.headers)
            and (self.cycle is None or self.cycle.response_complete)
            and self.parser.get_http_version() == "1.1"
            and self.parser.should_keep_alive()
            and not self.parser.should_upgrade()
            and not self.flow.write_paused
            and len(self.connections) <= self._crowd
        ):
            self._is_held, self.body = True, b""
        else:
            self._begin()

    def on_body(self, body: bytes) -> None:
        """Receive a part of the body."""
        if self._is_held:
            self.body += body
        else:
            super().on_body(body)

    def on_message_complete(self) -> None:
        """Complete the request."""
        if self._is_held:
            assert self._plain is not None
            self._is_held, self.is_waiting = False, True
            self.scope["method"] = "POST"
            self._plain.add(self)
        else:
            super().on_message_complete()

    def answer(self, status: int, head: bytes, body: bytes) -> None:
        """Send the response to a plain request. head: its header lines and an empty line."""
        self.is_waiting, self.body = False, b""
        if not self.transport.is_closing():
            default = header_lines(tuple(self.server_state.default_headers))
            self.transport.write(b"".join((STATUS_LINE[status], default, head, body)))
            self.on_response_complete()

    def pass_on(self) -> None:
        """Let the application answer a plain request."""
        self.is_waiting = False
        if not self.transport.is_closing():
            self._start()
            super().on_message_complete()

    def _flush_plain(self) -> None:
        if self.is_waiting:
            assert self._plain is not None
            self._plain.flush()

    def _start(self) -> None:
        body, self.body = self.body, b""  # an idle connection keeps none
        self._begin()
        if body:
            super().on_body(body)

    def _begin(self) -> None:
        super().on_headers_complete()
        if not self.cycle:  # an upgrade
            return
        if len(self.connections) > self._crowd:
            self.cycle.keep_alive = False

    def send_400_response(self, _: str) -> None:
        """Answer bytes that are not HTTP."""
        self.transport.write(MALFORMED)
        self.transport.close()

    def handle_websocket_upgrade(self) -> None:
        """Hand over the connection."""
        self._release()
        super().handle_websocket_upgrade()

    def _is_admitted(self) -> bool:
        """Count the connection. Returns whether its address may have as many."""
        if self.client is None or _is_loopback(self.client[0]):
            return True
        open_connections = _addresses.setdefault(self.server_state, Counter())
        if open_connections[self.client[0]] >= _descriptors(OF_ONE_ADDRESS):
            return False
        self._address = self.client[0]
        open_connections[self._address] += 1
        return True

    def _release(self) -> None:
        if self._first_request is not None:
            self._first_request.cancel()
            self._first_request = None
        if self._address:
            open_connections = _addresses[self.server_state]
            open_connections[self._address] -= 1
            if not open_connections[self._address]:
                del open_connections[self._address]
            self._address = ""
