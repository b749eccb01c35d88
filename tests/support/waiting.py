"""Waits for a condition, with a deadline."""

import time
from collections.abc import Callable


def until(condition: Callable[[], object], seconds: float = 240) -> None:
    """Return as soon as `condition()` is true. Raises TimeoutError after `seconds`.

    The longer it has waited, the more rarely it asks, down to 20 times a second: conditions query databases and
    servers, which need the processor themselves.
    """
    deadline, pause = time.monotonic() + seconds, 0.01
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not true within {seconds} s: {getattr(condition, '__qualname__', condition)}")
        time.sleep(pause)
        pause = min(1.05 * pause, 0.05)
