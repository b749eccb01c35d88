"""Deadlines for games: interrupts an environment that hangs in a reset or step, or takes too long over one game.

In the main thread, a signal checks periodically: it interrupts Python code, sleeps and waits for locks. In other
threads there are no signals, and only completed steps are timed. Native code that does not return cannot be
interrupted; an expendable process, such as one of several workers, then exits with a traceback.

A thread sends the signal, because environments use the timers of the process, with SIGALRM, for time limits of their
own.
"""

from __future__ import annotations

import faulthandler
import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from league.environments.stepping import BatchedEnvironment
from league.errors import GameHung, LeagueError

logger = logging.getLogger(__name__)

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
TICK = signal.SIGURG
"""The signal of the checks. Environments and libraries do not use it, Linux and macOS have it, and by default it is
ignored: one that arrives late does not end the process, as a real-time signal would."""
CLOSE_SECONDS = 10.0
"""Seconds after which closing environments is given up, as long as Docker waits for a container."""
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

    Has no effect in other threads. In a block within another one, both checks are called. The previous signal handler
    is restored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    every = min(max(deadline.seconds / 4, MOST_OFTEN), LEAST_OFTEN)
    main, end = threading.get_ident(), threading.Event()
    is_over = False

    def tick(signum: int, frame: FrameType | None) -> None:
        if callable(previous):
            previous(signum, frame)
        if not is_over:
            _extend_deadline(deadline)
            check()

    def send() -> None:
        while not end.wait(every):
            signal.pthread_kill(main, TICK)

    previous = signal.getsignal(TICK)
    signal.signal(TICK, tick)
    sender = threading.Thread(target=send, name="watchdog", daemon=True)
    sender.start()
    _extend_deadline(deadline)
    try:
        yield
    finally:
        is_over = True
        end.set()
        sender.join()
        if deadline.expendable:
            faulthandler.cancel_dump_traceback_later()
        signal.signal(TICK, previous)


def close_in_time(environment: BatchedEnvironment, expendable: bool = False) -> None:
    """Close an environment for at most CLOSE_SECONDS, and log if it hangs. expendable: see Deadline."""
    end = time.monotonic() + CLOSE_SECONDS

    def check() -> None:
        if time.monotonic() > end:
            raise GameTimeout(GameHung(f"the environment's close has not ended after {CLOSE_SECONDS:g} s"))

    try:
        with enforce_deadline(check, Deadline(CLOSE_SECONDS, expendable)):
            environment.close()
    except GameTimeout as expired:
        logger.warning("%s", expired.error)


def _extend_deadline(deadline: Deadline) -> None:
    """Postpone the exit of this process."""
    if deadline.expendable:
        faulthandler.dump_traceback_later(deadline.seconds + GRACE, exit=True, file=STDERR)
