"""Which process publishes a version, and whether it still can."""

import os
import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path

LONGEST_PUBLICATION = timedelta(days=1)
"""A process of another machine is given up after this; publishing takes seconds to minutes."""


def this_process() -> str:
    """`host:pid:start`, where `start` tells two processes of one id apart, as far as the system says."""
    return f"{socket.gethostname()}:{os.getpid()}:{_start(os.getpid())}"


def is_gone(publisher: str, reserved_at: datetime) -> bool:
    """Whether `publisher` will not finish what it began at `reserved_at`.

    A wrong yes costs that process its publication and nothing else: it can then no longer be made ready.
    """
    host, pid, start = publisher.rsplit(":", 2)
    if datetime.now(UTC) - reserved_at > LONGEST_PUBLICATION:
        return True
    return host == socket.gethostname() and not (_exists(int(pid)) and _start(int(pid)) == start)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _start(pid: int) -> str:
    """Clock ticks from boot to a process's start (proc(5), stat field 22); empty where there is no /proc."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except OSError:
        return ""
