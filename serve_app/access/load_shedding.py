"""Sheds load before a queue builds up: requests beyond the limits are refused at once with 429.

A replica handles requests on one event loop, and runs small inferences on it. Most of its queue is therefore implicit:
requests that arrived while the loop was busy, all of which start in the next turn, and connections that are not
accepted yet. Those of the fast path wait in a queue of their own. A turn accepts requests until `limit` of them wait,
or as many as are answered in MAX_WAIT seconds, and only those that it reaches within `time_limit` seconds. As in CoDel
(Nichols and Jacobson, 2012, "Controlling queue delay"), bursts may exceed all limits; requests are refused only when
the queue stays too long for more than `burst_tolerance` seconds.
"""

import asyncio
from collections.abc import Callable
from time import monotonic

from league.errors import Overloaded
from serve_app.runtime.uvicorn_http import AcceptQueue

NEVER = float("inf")
MAX_WAIT = 0.25
"""Seconds that a request of the queue waits, nearly, before further ones are refused."""
WEIGHT = 1 / 8
"""That of the last turn in the mean duration of a request."""


class Backlog:
    """The requests of one turn of the event loop.

    While overloaded, a turn accepts requests until `limit` wait, and none after `time_limit` seconds, but always at
    least one if none waits.
    """

    __slots__ = (
        "_burst_tolerance",
        "_clock",
        "_is_continuing",
        "_limit",
        "_overloaded_since",
        "_queue",
        "_seconds",
        "_time_limit",
        "_turn_started",
        "_unaccepted",
        "_waiting",
        "queued",
        "turn",
    )

    def __init__(
        self, limit: int, time_limit: float, burst_tolerance: float, clock: Callable[[], float] = monotonic
    ) -> None:
        self._limit = limit
        self._time_limit = time_limit
        self._burst_tolerance = burst_tolerance
        self._clock = clock
        self._queue: AcceptQueue | None = None
        self._unaccepted = 0
        self._waiting = 0
        self.queued = 0
        """Accepted requests of earlier turns that still wait."""
        self._seconds = 0.0
        """Mean duration of a request of the queue."""
        self.turn = 0
        """Number of turns in which requests were admitted."""
        self._turn_started = 0.0
        self._overloaded_since = NEVER
        self._is_continuing = False

    def end_slice(self, answered: int, seconds: float, queued: int) -> None:
        """The queue has `answered` requests in this turn, in `seconds`, and `queued` ones wait for the next one."""
        self.queued = queued
        if answered:
            self._seconds += WEIGHT * (seconds / answered - self._seconds)

    def watch_port(self, port: int) -> None:
        """Also count connections that wait to be accepted on this port. Later calls have no effect."""
        if self._queue is None:
            self._queue = AcceptQueue(port)

    def admit(self) -> None:
        """Let a request start. Raises Overloaded."""
        if not self._waiting:
            # Callbacks scheduled now run in the next turn, before requests that arrive in the meantime.
            asyncio.get_running_loop().call_soon(self._end_turn)
            self._turn_started = self._clock()
            self._is_continuing = True
            self._unaccepted = 0 if self._queue is None else self._queue.length()
        self._waiting += 1
        # The queue was too long in every turn for longer than the tolerance, regardless of the length of a turn.
        if self._turn_started - self._overloaded_since > self._burst_tolerance and self._is_overloaded():
            raise Overloaded("too many requests are waiting in this replica")

    def _end_turn(self) -> None:
        is_overloaded = self._is_overloaded()
        self.turn += 1
        self._waiting = 0
        if not is_overloaded:
            # A queue must have become short, or each burst that follows would be tolerated anew.
            if 2 * self.queued < min(self._limit, MAX_WAIT / self._seconds if self._seconds else NEVER):
                self._overloaded_since = NEVER
            return
        self._overloaded_since = min(self._overloaded_since, self._clock())
        self._is_continuing = False
        loop = asyncio.get_running_loop()
        loop.call_soon(loop.call_soon, self._end_queue)  # after the next turn

    def _end_queue(self) -> None:
        """The queue is empty if a turn passes without a request, and none waits, nor a connection to be accepted."""
        if not self._is_continuing and not self.queued and not (self._queue and self._queue.length()):
            self._overloaded_since = NEVER

    def _is_overloaded(self) -> bool:
        waiting = self.queued + self._waiting + self._unaccepted
        if waiting > self._limit or (self.queued and waiting * self._seconds > MAX_WAIT):
            return True
        return self._waiting > 1 and self._clock() - self._turn_started > self._time_limit
