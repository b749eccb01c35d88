"""Sheds load before a queue grows: those who would wait behind too many others are told at once to come back.

A replica answers on one event loop, and small inferences run on it. The queue is therefore not a list: it is the
requests that have arrived while the loop was busy, all of which its next turn begins, and those on connections that it
has not accepted yet. Their number is what this counts, up to the `limit` that are taken. As in CoDel (Nichols and
Jacobson, 2012, "Controlling queue delay"), a burst may exceed it: only a queue that stays too long for `patience`
seconds is cut.
"""

import asyncio
from collections.abc import Callable
from time import monotonic

from league.errors import Overloaded
from serve_app.accept_queue import AcceptQueue

NEVER = float("inf")


class Backlog:
    """The requests of one turn of the event loop. limit: those that it takes, once its queue stays too long."""

    __slots__ = ("_begun", "_clock", "_goes_on", "_limit", "_long_since", "_patience", "_queue", "_unseen", "_waiting")

    def __init__(self, limit: int, patience: float, clock: Callable[[], float] = monotonic) -> None:
        self._limit = limit
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
        if self._waiting + self._unseen > self._limit and self._begun - self._long_since > self._patience:
            raise Overloaded(f"more than {self._limit} requests wait here already")

    def _end_turn(self) -> None:
        is_long = self._waiting + self._unseen > self._limit
        self._waiting = 0
        if not is_long:
            self._long_since = NEVER
            return
        self._long_since = min(self._long_since, self._clock())
        self._goes_on = False
        loop = asyncio.get_running_loop()
        loop.call_soon(loop.call_soon, self._end_queue)  # after the next turn

    def _end_queue(self) -> None:
        """Nobody waits any more if a turn passes without a request."""
        if not self._goes_on:
            self._long_since = NEVER
