"""How often a caller may call: a token bucket that holds what one second brings."""

from collections.abc import Callable
from time import monotonic


class TokenBucket:
    """Holds `rate` tokens (at least one) at most, and gains `rate` of them per second."""

    __slots__ = ("_at", "_clock", "_size", "_tokens", "rate")

    def __init__(self, rate: float, clock: Callable[[], float] = monotonic) -> None:
        self.rate = rate
        self._size = max(1.0, rate)
        self._tokens = self._size
        self._clock = clock
        self._at = clock()

    def take(self) -> float:
        """Take a token; returns 0, or in how many seconds there will be one."""
        now = self._clock()
        self._tokens = min(self._size, self._tokens + (now - self._at) * self.rate)
        self._at = now
        if self._tokens >= 1:
            self._tokens -= 1
            return 0.0
        return (1 - self._tokens) / self.rate
