"""A client of server-sent events."""

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import httpx

from tests.support.servers.streaming import Listening
from tests.support.waiting import until

LEAGUE = "/v1/leagues/board/events"


class EventStream:
    """The lines received so far; `is_over` once the stream has ended."""

    def __init__(self, reply: httpx.Response) -> None:
        self.reply = reply
        self.lines: list[str] = []
        self.is_over = False
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        with suppress(httpx.HTTPError):
            self.lines.extend(self.reply.iter_lines())
        self.is_over = True

    def close(self) -> None:
        """Close the connection, unless the server has closed it."""
        with suppress(OSError):
            self.reply.extensions["network_stream"].get_extra_info("socket").shutdown(socket.SHUT_RDWR)
        self._thread.join()

    @property
    def events(self) -> list[tuple[str, dict[str, Any]]]:
        """Name and data of each complete event."""
        lines = list(self.lines)
        starts = [at for at, line in enumerate(lines[:-1]) if line.startswith("event: ")]
        return [(lines[at].removeprefix("event: "), json.loads(lines[at + 1].removeprefix("data: "))) for at in starts]

    @property
    def last(self) -> dict[str, Any]:
        return self.events[-1][1]


@contextmanager
def listen(server: Listening | str, path: str = LEAGUE, **headers: str) -> Iterator[EventStream]:
    """Listen while the context lasts; it starts after the first event or an error response."""
    base = server if isinstance(server, str) else server.url
    with httpx.stream("GET", f"{base}{path}", headers=headers, timeout=60, verify=False) as reply:
        stream = EventStream(reply)
        try:
            until(lambda: bool(stream.events) or stream.is_over)
            yield stream
        finally:
            stream.close()
