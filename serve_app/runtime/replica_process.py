"""Where a replica runs, and whether the process of another one has ended.

A process knows this only of processes on its machine and of actors in its Ray cluster. A replica that is stuck, or cut
off from the network, has not ended.
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")


@dataclass(frozen=True, slots=True)
class ReplicaProcess:
    """The process of this replica.

    description: where it runs, for other replicas. has_ended: whether the process with a description has certainly
    ended.
    """

    description: Mapping[str, str]
    has_ended: Callable[[Mapping[str, str]], bool]


def this_process() -> ReplicaProcess:
    """This process, known by its machine. Other systems than Linux give no description."""
    try:
        return ReplicaProcess({"machine": _machine(), "pid": str(os.getpid()), "start": _start(os.getpid())}, has_ended)
    except OSError:
        return ReplicaProcess({}, has_ended)


def has_ended(other: Mapping[str, str]) -> bool:
    """Whether a process ran on this machine, since its last start and in this container, and has ended."""
    try:
        if other.get("machine") != _machine():
            return False
    except OSError:
        return False
    try:
        return _start(int(other["pid"])) != other["start"]
    except (FileNotFoundError, ProcessLookupError):
        return True


def _machine() -> str:
    """Machine, its last start, and the container: process ids are unique within these."""
    boot = (PROC / "sys/kernel/random/boot_id").read_text().strip()
    return f"{boot}/{os.stat(PROC / 'self/ns/pid').st_ino}"


def _start(pid: int) -> str:
    """When a process started, in ticks since the machine did: process ids are used again."""
    # The command's name, in parentheses, may contain spaces. See proc(5).
    fields = (PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    state, start = fields[0], fields[19]
    if state in "ZX":
        raise FileNotFoundError(f"process {pid} has ended")
    return start
