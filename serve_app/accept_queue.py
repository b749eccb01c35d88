"""How many connections wait to be accepted: requests that the event loop has not seen yet.

uvloop accepts one connection in each turn. Where many come at once and turns are long, that is where the queue is.
"""

import os
import socket
import stat
from contextlib import suppress
from pathlib import Path

TCP_INFO_BYTES = 28
UNACKED = slice(24, 28)
"""Where struct tcp_info (linux/tcp.h) has `tcpi_unacked`: of a listening socket, the connections in its queue."""


class AcceptQueue:
    """The queue of the socket of this process that listens on a port; always empty if there is none."""

    __slots__ = ("_listener",)

    def __init__(self, port: int) -> None:
        self._listener = _listener(port)

    def __del__(self) -> None:
        if self._listener is not None:
            self._listener.detach()

    def length(self) -> int:
        """Connections in it. Costs a microsecond."""
        if self._listener is None:
            return 0
        try:
            info = self._listener.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO_BYTES)
        except OSError:  # it listens no more
            return 0
        return int.from_bytes(info[UNACKED], "little")


def _listener(port: int) -> socket.socket | None:
    """The socket itself. A copy would go on listening when its owner has closed it; this is not ours to close."""
    with suppress(OSError, AttributeError):  # no /proc, no TCP_INFO: not Linux
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
