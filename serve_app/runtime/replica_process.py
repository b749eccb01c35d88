"""Where a replica runs, and whether the process of another one has ended.

A process knows this only of processes on its machine and of actors in its Ray cluster. A replica that is stuck, or cut
off from the network, has not ended.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from league.registry import processes
from league.registry.replicas import PROCESS


@dataclass(frozen=True, slots=True)
class ReplicaProcess:
    """The process of this replica.

    description: where it runs, for other replicas. has_ended: whether the process with a description has certainly
    ended.
    """

    description: Mapping[str, str]
    has_ended: Callable[[Mapping[str, str]], bool]


def this_process() -> ReplicaProcess:
    """This process, known by its machine."""
    return ReplicaProcess({PROCESS: processes.this_process()}, has_ended)


def has_ended(other: Mapping[str, str]) -> bool:
    """Whether a process ran on this machine, since its last start and in this container, and has ended."""
    return PROCESS in other and processes.has_ended(other[PROCESS])
