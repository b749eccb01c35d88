"""Caches the registry's API keys, with a token bucket per key.

Lookup by digest in a dictionary leaks nothing useful through timing: an attacker cannot steer the SHA-256 of a guess
towards the digest of a key.
"""

import asyncio
import hashlib
from collections.abc import AsyncIterator, Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from time import monotonic, time

from league.errors import StorageError
from league.registry.keys import TOKEN_LENGTH
from league.registry.registry import Registry
from league.registry.storage.rows import KeyRow
from serve_app.models.polling import Polling
from serve_app.settings import ServeSettings


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
        now = self._clock()
        self._tokens = min(self._size, self._tokens + (now - self._at) * self.rate)
        self._at = now


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

    def update(self, rows: Iterable[KeyRow]) -> None:
        """Replace the keys. A key that is unchanged keeps its token bucket."""
        rows = list(rows)
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
        known = self._keys.get(bytes.fromhex(row.sha256))
        if known is not None and known.row == row:
            return known
        return ApiKey(row, None if row.rate is None else TokenBucket(row.rate))


class ApiKeyWatcher:
    """Keeps the key cache up to date, independently of the alias watcher: a version that loads slowly does not delay a
    revocation. While the database is unavailable, the cached keys stay valid.
    """

    def __init__(self, registry: Registry, api_keys: ApiKeyCache, settings: ServeSettings) -> None:
        self._registry = registry
        self._api_keys = api_keys
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="keys")
        self._polling = Polling(self.poll_once, "API keys", settings)

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Poll the keys while the context is active; enters after the first successful poll."""
        try:
            async with self._polling.running():
                yield
        finally:
            self._thread.shutdown(wait=False, cancel_futures=True)

    async def poll_once(self) -> None:
        """Read the keys once. Raises StorageError."""
        rows = await asyncio.get_running_loop().run_in_executor(self._thread, self._registry.keys.all)
        if not rows and not self._api_keys.is_empty:
            # Revoked keys stay in the registry. With an empty cache the server would accept requests without a key.
            raise StorageError("the registry has no API keys, but had some before: it is a different database")
        self._api_keys.update(rows)
        self._polling.mark_ready()
