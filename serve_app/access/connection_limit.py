"""Limits the connections that stay open: in a replica, and for each API key."""

import resource
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from league.errors import Overloaded
from serve_app.access.api_keys import ApiKey

DESCRIPTORS = 0.75
"""Share of a process's file descriptors that connections of one kind may use. Other connections, databases and files
need the rest; without one, a process accepts no connection at all."""


def within_descriptors(limit: int) -> int:
    """Return how many connections of one kind, at most `limit`, this process may hold."""
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return limit if descriptors == resource.RLIM_INFINITY else min(limit, int(DESCRIPTORS * descriptors))


class ConnectionLimit:
    """The open connections of one kind. what: their name in error messages, `streams`."""

    def __init__(self, what: str, limit: int, limit_per_key: int) -> None:
        self._what = what
        self._limit = limit
        self._limit_per_key = limit_per_key
        self._of_key: Counter[str] = Counter()
        self.open = 0
        """Number of open connections."""

    @contextmanager
    def opened(self, key: ApiKey | None) -> Iterator[None]:
        """Count a connection of a key while the context is active. Raises Overloaded."""
        if self.open >= self._limit:
            raise Overloaded(f"{self.open} {self._what} are open in this replica")
        if key is not None and self._of_key[key.id] >= self._limit_per_key:
            raise Overloaded(f"{self._limit_per_key} {self._what} of the key {key.name} are open in this replica")
        self.open += 1
        if key is not None:
            self._of_key[key.id] += 1
        try:
            yield
        finally:
            self.open -= 1
            if key is not None:
                self._of_key[key.id] -= 1
                self._of_key += Counter()  # drops keys without connections
