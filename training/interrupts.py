"""Ctrl-C while training: the first one asks it to end cleanly, the second one ends it at once."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """Training was asked to end, and has: all that it learned is saved. The message says what there is and how to go
    on. A KeyboardInterrupt, so that whoever does not know better ends, too."""


@contextmanager
def first_asks(ask: Callable[[], None]) -> Iterator[None]:
    """SIGINT and SIGTERM call `ask` once; a further one raises KeyboardInterrupt. Elsewhere than in the main thread,
    where Python takes no signals, nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = False

    def handle(*_: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        ask()

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
