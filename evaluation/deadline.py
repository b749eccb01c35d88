"""Games that do not end: an environment that hangs in a reset or a step, or takes too long over one game.

While games are played in the main thread, a timer looks every so often at what the environment is at: a signal
interrupts Python code, a sleep, or a wait for a lock. In another thread there is no signal, and all that is looked at
is how long steps took that came to an end. Native code that does not come back is interrupted by nothing: a process
that is expendable, such as a worker of many, then ends itself and says where it was.
"""

from __future__ import annotations

import faulthandler
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from league.errors import LeagueError

STDERR = 2
"""The file descriptor: whoever has taken the place of `sys.stderr` may have none."""


@dataclass(frozen=True, slots=True)
class Deadline:
    """seconds: how long an environment may work on one game.
    expendable: whether this process ends, with a traceback on stderr, when for so long and `GRACE` no Python ran.
    """

    seconds: float = 600.0
    expendable: bool = False


GRACE = 30.0
"""Seconds."""
MOST_OFTEN, LEAST_OFTEN = 0.01, 1.0
"""Seconds between two looks."""


class Expired(BaseException):
    """The time is up, which is to be told as `error`. No Exception, since the environment that it interrupts may well
    catch those.
    """

    def __init__(self, error: LeagueError) -> None:
        super().__init__(str(error))
        self.error = error


@contextmanager
def watched(look: Callable[[], None], deadline: Deadline) -> Iterator[None]:
    """Call `look` every so often, in between of whatever the main thread does in the block; it may raise Expired.

    Does nothing in another thread. Handler and timer of before are put back in the end.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    every = min(max(deadline.seconds / 4, MOST_OFTEN), LEAST_OFTEN)
    is_over = False

    def tick(signum: int, frame: FrameType | None) -> None:  # noqa: ARG001  signal's own form
        if not is_over:
            _outlive(deadline)
            look()

    began = time.monotonic()
    handler = signal.signal(signal.SIGALRM, tick)
    rest, interval = signal.setitimer(signal.ITIMER_REAL, every, every)
    _outlive(deadline)
    try:
        yield
    finally:
        is_over = True
        signal.setitimer(signal.ITIMER_REAL, 0)
        if deadline.expendable:
            faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, handler)
        if rest:
            signal.setitimer(signal.ITIMER_REAL, max(rest - (time.monotonic() - began), MOST_OFTEN), interval)


def _outlive(deadline: Deadline) -> None:
    """Put this process's end off once more."""
    if deadline.expendable:
        faulthandler.dump_traceback_later(deadline.seconds + GRACE, exit=True, file=STDERR)
