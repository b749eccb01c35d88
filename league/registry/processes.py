"""Identifies processes across machines: whether one that wrote a record is still alive."""

import os
import socket
from pathlib import Path


def this_process() -> str:
    """Return `machine:pid:start`, where `start` distinguishes processes that reuse a pid, if the system reports it."""
    return f"{this_machine()}:{os.getpid()}:{_start(os.getpid())}"


def is_local(process: str) -> bool:
    """Return whether a process runs, or ran, on this machine, since its last start and in this container."""
    return process.rsplit(":", 2)[0] == this_machine()


def has_ended(process: str) -> bool:
    """Return whether a process ran on this machine and has ended. False for those of other machines."""
    if not is_local(process):
        return False
    _, pid, start = process.rsplit(":", 2)
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        pass  # of another user
    return _start(int(pid)) != start


def host_name(process: str) -> str:
    """Return the name of the machine of a process."""
    return process.rsplit(":", 2)[0].partition("/")[0]


def this_machine() -> str:
    """Return host name, last start and container, if the system reports them: several may have the same name."""
    try:
        boot, container = (
            Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
            os.stat("/proc/self/ns/pid").st_ino,
        )
    except OSError:
        return socket.gethostname()
    return f"{socket.gethostname()}/{boot}/{container}"


def _start(pid: int) -> str:
    """Clock ticks from boot to the start of a process; empty if it has ended, or if there is no /proc."""
    try:
        # The command's name, in parentheses, may contain spaces. See proc(5).
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    state, start = fields[0], fields[19]
    return "" if state in "ZX" else start
