"""Sheds load before a queue builds up: what would wait for longer than `max_wait` is refused at once with 429.

A replica handles requests on one event loop, and runs small inferences on it. Small requests wait in a queue (see
`InferenceQueue`), and the others start in the turn of the event loop that follows their arrival, one after the other. A
request waits for those of the queue and those that its turn has started before it.
"""

import asyncio
from collections.abc import Callable
from time import monotonic

from league.errors import Overloaded

WEIGHT = 1 / 8
"""That of the last turn in the mean duration of a request."""


class Backlog:
    """What a request waits for, in seconds.

    max_wait: how long an accepted one waits, nearly. clock: in seconds.
    """

    __slots__ = ("_clock", "_max_wait", "_seconds", "_turn_started", "queued")

    def __init__(self, max_wait: float, clock: Callable[[], float] = monotonic) -> None:
        self._max_wait = max_wait
        self._clock = clock
        self._seconds = 0.0
        """Mean duration of a request of the queue."""
        self._turn_started: float | None = None
        """When the first request of this turn was admitted."""
        self.queued = 0
        """Requests in the queue."""

    def count_answered(self, count: int, seconds: float) -> None:
        """Count requests of the queue that were answered in `seconds`."""
        self._seconds += WEIGHT * (seconds / count - self._seconds)

    def admit(self) -> None:
        """Let a request start, or enter the queue. Raises Overloaded."""
        current_time = self._clock()
        if self._turn_started is None:
            self._turn_started = current_time
            # Callbacks scheduled now run in the next turn, before requests that arrive in the meantime.
            asyncio.get_running_loop().call_soon(self._end_turn)
        if self.queued * self._seconds + current_time - self._turn_started > self._max_wait:
            raise Overloaded("too many requests are waiting in this replica")

    def _end_turn(self) -> None:
        self._turn_started = None
