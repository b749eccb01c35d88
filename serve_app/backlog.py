"""Sheds load before a queue grows: those who would wait behind too many others are told at once to come back.

A replica answers on one event loop, and small inferences run on it. The queue is therefore not a list: it is the
requests that have arrived while the loop was busy, all of which its next turn begins, and those on connections that it
has not accepted yet. A turn takes a `limit` of them, and those that it comes to within a `share` of time: of heavy
requests few, of light ones many. As in CoDel (Nichols and Jacobson, 2012, "Controlling queue delay"), a burst may
exceed both: only a queue that stays too long for `patience` seconds is cut.
"""

import asyncio
from collections.abc import Callable
from time import monotonic

from league.errors import Overloaded
from serve_app.accept_queue import AcceptQueue

NEVER = float("inf")


class Backlog:
    """The requests of one turn of the event loop. Once the queue stays too long a turn takes `limit` of them, and none
    when it has lasted for `share` seconds, but always one."""

    __slots__ = (
        "_begun",
        "_clock",
        "_goes_on",
        "_limit",
        "_long_since",
        "_patience",
        "_queue",
        "_share",
        "_unseen",
        "_waiting",
    )

    def __init__(self, limit: int, share: float, patience: float, clock: Callable[[], float] = monotonic) -> None:
        self._limit = limit
        self._share = share
        self._patience = patience
        self._clock = clock
        self._queue: AcceptQueue | None = None
        self._unseen = 0
        self._waiting = 0
        self._begun = 0.0
        self._long_since = NEVER
        self._goes_on = False

    def listens_on(self, port: int) -> None:
        """Count the connections, too, that wait to be accepted there. Only the first port counts."""
        if self._queue is None:
            self._queue = AcceptQueue(port)

    def admit(self) -> None:
        """Let a request begin. Raises Overloaded."""
        if not self._waiting:
            # What is called soon is called in the next turn, before what arrives meanwhile.
            asyncio.get_running_loop().call_soon(self._end_turn)
            self._begun = self._clock()
            self._goes_on = True
            self._unseen = 0 if self._queue is None else self._queue.length()
        self._waiting += 1
        # Whether the queue was too long in every turn for more than `patience` seconds, however long a turn takes.
        if self._begun - self._long_since > self._patience and self._is_long():
            raise Overloaded("more requests wait here than can be answered soon")

    def _end_turn(self) -> None:
        is_long = self._is_long()
        self._waiting = 0
        if not is_long:
            self._long_since = NEVER
            return
        self._long_since = min(self._long_since, self._clock())
        self._goes_on = False
        loop = asyncio.get_running_loop()
        loop.call_soon(loop.call_soon, self._end_queue)  # after the next turn

    def _end_queue(self) -> None:
        """Nobody waits any more if a turn passes without a request, and no connection waits to be accepted."""
        if not self._goes_on and not (self._queue and self._queue.length()):
            self._long_since = NEVER

    def _is_long(self) -> bool:
        if self._waiting + self._unseen > self._limit:
            return True
        return self._waiting > 1 and self._clock() - self._begun > self._share
