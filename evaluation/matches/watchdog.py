"""Deadlines for games: interrupts an environment that hangs in a reset or step, or takes too long over one game.

In the main thread, a timer signal checks periodically: it interrupts Python code, sleeps and waits for locks. In other
threads there are no signals, and only completed steps are timed. Native code that does not return cannot be
interrupted; an expendable process, such as one of several workers, then exits with a traceback.
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
"""File descriptor, because a replacement of `sys.stderr` may have none."""


@dataclass(frozen=True, slots=True)
class Deadline:
    """Time limit of a game.

    seconds: working time of an environment per game. expendable: whether this process exits with a traceback on stderr
    if no Python code ran for `seconds` + `GRACE`.
    """

    seconds: float = 600.0
    expendable: bool = False


GRACE = 30.0
"""Seconds."""
MOST_OFTEN, LEAST_OFTEN = 0.01, 1.0
"""Seconds between two checks."""


class GameTimeout(BaseException):
    """The time limit was exceeded; `error` describes it. Not an Exception, because the interrupted environment may
    catch exceptions.
    """

    def __init__(self, error: LeagueError) -> None:
        super().__init__(str(error))
        self.error = error


@contextmanager
def enforce_deadline(check: Callable[[], None], deadline: Deadline) -> Iterator[None]:
    """Call `check` periodically while the main thread runs the block. It may raise GameTimeout.

    Has no effect in other threads. The previous signal handler and timer are restored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    every = min(max(deadline.seconds / 4, MOST_OFTEN), LEAST_OFTEN)
    is_over = False

    def tick(signum: int, frame: FrameType | None) -> None:  # noqa: ARG001  signal's own form
        if not is_over:
            _extend_deadline(deadline)
            check()

    began = time.monotonic()
    handler = signal.signal(signal.SIGALRM, tick)
    delay, interval = signal.setitimer(signal.ITIMER_REAL, every, every)
    _extend_deadline(deadline)
    try:
        yield
    finally:
        is_over = True
        signal.setitimer(signal.ITIMER_REAL, 0)
        if deadline.expendable:
            faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, handler)
        if delay:
            signal.setitimer(signal.ITIMER_REAL, max(delay - (time.monotonic() - began), MOST_OFTEN), interval)


def _extend_deadline(deadline: Deadline) -> None:
    """Postpone the exit of this process."""
    if deadline.expendable:
        faulthandler.dump_traceback_later(deadline.seconds + GRACE, exit=True, file=STDERR)
