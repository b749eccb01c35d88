"""The API keys as a replica holds them: found by their digest, without a look at the database.

Finding a key by a dictionary of digests tells an attacker nothing by the time it takes: what is compared is SHA-256 of
what was sent, which cannot be steered towards that of a key.
"""

import asyncio
import hashlib
from collections.abc import AsyncIterator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from time import time

from league.errors import StorageError
from league.registry.keys import TOKEN_LENGTH
from league.registry.registry import Registry
from league.registry.rows import KeyRow
from serve_app.polling import Polling
from serve_app.rate_limits import TokenBucket
from serve_app.settings import ServeSettings


class Key:
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


class Keyring:
    """All keys. `follow` gives it what the registry has."""

    def __init__(self) -> None:
        self._keys: dict[bytes, Key] = {}
        self.is_empty = True
        """Whether there never was a key."""

    def follow(self, rows: Iterable[KeyRow]) -> None:
        """Hold these keys from now on. A key that stays keeps what it has used up of its rate."""
        rows = list(rows)
        self._keys = {bytes.fromhex(row.sha256): self._key(row) for row in rows if row.revoked_at is None}
        self.is_empty = not rows

    def find(self, token: bytes) -> Key | None:
        """The key whose text this is, unless it is revoked or has expired."""
        if len(token) != TOKEN_LENGTH:
            return None
        key = self._keys.get(hashlib.sha256(token).digest())
        return key if key is not None and time() < key.expires else None

    def holds(self, key: Key) -> bool:
        """Whether a key that was found is still one."""
        return self._keys.get(key.digest) is key and time() < key.expires

    def _key(self, row: KeyRow) -> Key:
        known = self._keys.get(bytes.fromhex(row.sha256))
        if known is not None and known.row == row:
            return known
        return Key(row, None if row.rate is None else TokenBucket(row.rate))


class KeyWatcher:
    """Keeps a keyring at the registry's keys, beside the alias watcher: a version that loads slowly delays no
    revocation. While the database is gone, the keys that are known stay."""

    def __init__(self, registry: Registry, keyring: Keyring, settings: ServeSettings) -> None:
        self._registry = registry
        self._keyring = keyring
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="keys")
        self._polling = Polling(self.look, "the API keys", settings)

    @asynccontextmanager
    async def watching(self) -> AsyncIterator[None]:
        """Follow the keys while the context lasts, which begins when they were seen once."""
        try:
            async with self._polling.running():
                yield
        finally:
            self._thread.shutdown(wait=False, cancel_futures=True)

    async def look(self) -> None:
        """Look at the keys once. Raises StorageError."""
        rows = await asyncio.get_running_loop().run_in_executor(self._thread, self._registry.api_keys)
        if not rows and not self._keyring.is_empty:
            # Revoked keys stay in the registry. Without a key the doors would stand open.
            raise StorageError("the registry has no API key any more: it is not the one that was there")
        self._keyring.follow(rows)
        self._polling.saw()
