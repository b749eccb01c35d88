"""The signals that end a command: their handling, and the exit code after one."""

import os
import signal
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NoReturn

_last_signal = signal.SIGINT


def ending_signals() -> tuple[signal.Signals, ...]:
    """Return SIGINT, SIGTERM and SIGHUP, the last only unless this process ignores it, as after `nohup`."""
    is_kept = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM) if is_kept else (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def interrupt() -> NoReturn:
    """Raise KeyboardInterrupt, which leaves no environment open and no file half-written."""
    raise KeyboardInterrupt


@contextmanager
def on_ending_signals(handle: Callable[[], None] = interrupt) -> Iterator[None]:
    """Call `handle` at each signal that ends a command, and restore the former handlers at the end of the block.

    Does nothing outside the main thread, where Python cannot handle signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def receive(number: int, _: object) -> None:
        global _last_signal
        _last_signal = signal.Signals(number)
        if number == signal.SIGHUP:
            _leave_closed_terminal()
        handle()

    former = {number: signal.signal(number, receive) for number in ending_signals()}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _leave_closed_terminal() -> None:
    """Replace a terminal that was closed, so that output fails no longer."""
    for descriptor in range(3):
        if stat.S_ISCHR(os.fstat(descriptor).st_mode) and not os.isatty(descriptor):
            nothing = os.open(os.devnull, os.O_RDWR)
            os.dup2(nothing, descriptor)
            os.close(nothing)


@contextmanager
def hangup_blocked() -> Iterator[None]:
    """Block SIGHUP in this thread, and for good in the processes that it starts meanwhile.

    A terminal that is closed signals all processes of a command. Those that it works with must live until it has ended.
    """
    former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def exit_code() -> int:
    """Return the exit code of a command that a signal ended: 128 and its number, 130 for Ctrl-C or without a signal."""
    return 128 + _last_signal
