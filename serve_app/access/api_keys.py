"""Caches the registry's API keys, with a token bucket per key.

Lookup by digest in a dictionary leaks nothing useful through timing: an attacker cannot steer the SHA-256 of a guess
towards the digest of a key.
"""

import hashlib
from collections.abc import Callable, Sequence
from time import monotonic, time

from league.errors import StorageError
from league.registry.keys import TOKEN_LENGTH
from league.registry.storage.rows import KeyRow


class TokenBucket:
    """A token bucket with a capacity of `rate` tokens (at least one) that refills at `rate` tokens per second."""

    __slots__ = ("_at", "_clock", "_size", "_tokens", "rate")

    def __init__(self, rate: float, clock: Callable[[], float] = monotonic) -> None:
        self.rate = rate
        self._size = max(1.0, rate)
        self._tokens = self._size
        self._clock = clock
        self._at = clock()

    def take(self) -> float:
        """Take a token. Returns 0, or the number of seconds until a token is available."""
        self._refill()
        if self._tokens >= 1:
            self._tokens -= 1
            return 0.0
        return (1 - self._tokens) / self.rate

    def owe(self, tokens: float) -> float:
        """Take tokens that may not be available yet; until they are, `take` gives none.

        Returns 0, or the number of seconds until all that is owed is available, and takes nothing.
        """
        self._refill()
        if self._tokens < 0:
            return -self._tokens / self.rate
        self._tokens -= tokens
        return 0.0

    def _refill(self) -> None:
        current_time = self._clock()
        self._tokens = min(self._size, self._tokens + (current_time - self._at) * self.rate)
        self._at = current_time


class ApiKey:
    """A key that is not revoked."""

    __slots__ = ("bucket", "digest", "expires", "id", "leagues", "name", "row", "scopes")

    def __init__(self, row: KeyRow, bucket: TokenBucket | None) -> None:
        self.row = row
        self.id = row.id
        self.name = row.name
        self.digest = bytes.fromhex(row.sha256)
        self.scopes = row.scopes
        self.leagues = row.leagues
        self.expires = float("inf") if row.expires_at is None else row.expires_at.timestamp()
        self.bucket = bucket


class ApiKeyCache:
    """All keys of the registry. `update` replaces its contents."""

    def __init__(self) -> None:
        self._keys: dict[bytes, ApiKey] = {}
        self.is_empty = True
        """Whether the registry has never had a key."""

    def update(self, rows: Sequence[KeyRow]) -> None:
        """Replace the keys. A key that is unchanged keeps its token bucket.

        Raises StorageError if there are none, but were some before.
        """
        if not rows and not self.is_empty:
            # Revoked keys stay in the registry. With an empty cache the server would accept requests without a key.
            raise StorageError("the registry has no API keys, but had some before: it is a different database")
        self._keys = {bytes.fromhex(row.sha256): self._key(row) for row in rows if row.revoked_at is None}
        self.is_empty = not rows

    def find(self, token: bytes) -> ApiKey | None:
        """The key with this text, unless it is revoked or expired."""
        if len(token) != TOKEN_LENGTH:
            return None
        key = self._keys.get(hashlib.sha256(token).digest())
        return key if key is not None and time() < key.expires else None

    def holds(self, key: ApiKey) -> bool:
        """Whether a key that was found earlier is still valid."""
        return self._keys.get(key.digest) is key and time() < key.expires

    def _key(self, row: KeyRow) -> ApiKey:
        cached_key = self._keys.get(bytes.fromhex(row.sha256))
        if cached_key is not None and cached_key.row == row:
            return cached_key
        return ApiKey(row, None if row.rate is None else TokenBucket(row.rate))
