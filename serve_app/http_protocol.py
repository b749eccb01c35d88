"""uvicorn's HTTP, which accepts all connections that wait as soon as one is accepted, and says when the server stops.

uvloop accepts one in each turn of the event loop. A turn computes the requests of all connections that there are: when
many clients come at once with requests that take a while, the last would be seen after minutes.

A server that stops finishes what it has begun. An answer that lasts, a stream of events, has to be told of it.
"""

import asyncio
from collections.abc import Callable
from functools import partial
from typing import Any, cast
from weakref import WeakKeyDictionary

from uvicorn.config import Config
from uvicorn.protocols.http import auto
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.server import ServerState

from serve_app.accept_queue import AcceptQueue

_queues: "WeakKeyDictionary[ServerState, AcceptQueue]" = WeakKeyDictionary()
"""Of each server of this process."""


def install(when_stopping: Callable[[], None]) -> None:
    """Make this the protocol of uvicorn servers that are told nothing else, as Ray Serve's are.

    when_stopping: called for each connection that is there when the server stops.
    """
    auto.AutoHTTPProtocol = partial(HttpProtocol, when_stopping)  # type: ignore[assignment]


class HttpProtocol(HttpToolsProtocol):
    """One connection."""

    def __init__(
        self,
        when_stopping: Callable[[], None],
        config: Config,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._when_stopping = when_stopping

    def shutdown(self) -> None:
        """The server stops: finish the request in progress."""
        super().shutdown()
        self._when_stopping()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin, and let those begin that wait behind."""
        super().connection_made(cast(asyncio.Transport, transport))
        if self.server is None or self.server[1] is None:
            return
        queue = _queues.get(self.server_state)
        if queue is None:
            queue = _queues[self.server_state] = AcceptQueue(self.server[1])
        while (connection := queue.take()) is not None:
            begun = self.loop.create_task(self.loop.connect_accepted_socket(self._another, connection))
            self.server_state.tasks.add(begun)  # type: ignore[arg-type]
            begun.add_done_callback(self.server_state.tasks.discard)

    def _another(self) -> "HttpProtocol":
        return HttpProtocol(self._when_stopping, self.config, self.server_state, self.app_state, self.loop)
