"""Limits the connections that stay open: in a replica, and for each API key."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from league.errors import Overloaded
from serve_app.access.api_keys import ApiKey


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
