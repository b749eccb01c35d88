"""Where a replica runs, who reaches it, and whether the process of another one has ended.

A process knows this only of processes on its machine and of actors in its Ray cluster. A replica that is stuck, or cut
off from the network, has not ended.
"""

import gc
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from league.registry import processes
from league.registry.replicas import PROCESS, URL

LOOPBACK = "127.0.0.1"
GARBAGE = 5000
"""Objects that are not freed after which the garbage collector looks for cycles. With Python's 700 it would look at the
lists of requests that are being answered together: 49 for a board of connect four, 32 times."""


@dataclass(frozen=True, slots=True)
class ReplicaProcess:
    """The process of this replica.

    Attributes:
        description: Where it runs, for other replicas.
        has_ended: Whether the process with a description has certainly ended.
        address: Address of its machine.
        is_exposed: Whether other machines reach it.
        is_draining: Returns whether it is being stopped.
        url: Returns the URL at which programs of its machine reach it without HAProxy; empty until it listens.
    """

    description: Mapping[str, str]
    has_ended: Callable[[Mapping[str, str]], bool]
    address: str = LOOPBACK
    is_exposed: bool = False
    is_draining: Callable[[], bool] = lambda: False
    url: Callable[[], str] = lambda: ""

    def described(self) -> dict[str, str]:
        """The description, with the URL if there is one."""
        url = self.url()
        return dict(self.description) | ({URL: url} if url else {})


def collect_rarely() -> None:
    """Let the garbage collector ignore the objects of this process that exist now, and run rarely."""
    gc.freeze()
    gc.set_threshold(GARBAGE)


def this_process() -> ReplicaProcess:
    """This process, known by its machine."""
    return ReplicaProcess({PROCESS: processes.this_process()}, has_ended)


def has_ended(other: Mapping[str, str]) -> bool:
    """Whether a process ran on this machine, since its last start and in this container, and has ended."""
    return PROCESS in other and processes.has_ended(other[PROCESS])
