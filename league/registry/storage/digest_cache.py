"""Files of an object store, cached on the local disk by their SHA-256. Several processes may share a cache."""

import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from league.files import disk_errors

CACHE_LIMIT = 4 * 10**9
"""Bytes. The files that were not used for the longest time are removed beyond it."""


class DigestCache:
    """A directory of files that are named by their digest. limit: size of all files, in bytes."""

    def __init__(self, directory: Path, limit: int = CACHE_LIMIT) -> None:
        self._directory = directory
        self._limit = limit

    def read(self, sha256: str, fetch: Callable[[], bytes | None]) -> bytes | None:
        """Return the content with this digest, from the cache or else from `fetch`.

        A cached file that was damaged is fetched again. Content of `fetch` with another digest is returned, but not
        cached. None: `fetch` found nothing.
        """
        path = self._directory / sha256
        with suppress(OSError):
            content = path.read_bytes()
            if hashlib.sha256(content).hexdigest() == sha256:
                os.utime(path)
                return content
        fetched = fetch()
        if fetched is not None and hashlib.sha256(fetched).hexdigest() == sha256:
            self._write(path, fetched)
        return fetched

    def _write(self, path: Path, content: bytes) -> None:
        with disk_errors(path):
            self._directory.mkdir(parents=True, exist_ok=True)
            # Other processes may write the same file.
            descriptor, draft = tempfile.mkstemp(dir=self._directory, prefix=".part-")
            try:
                with os.fdopen(descriptor, "wb") as file:
                    file.write(content)
                Path(draft).replace(path)
            except BaseException:
                Path(draft).unlink(missing_ok=True)
                raise
        self._evict(path)

    def _evict(self, newest: Path) -> None:
        entries = []
        for path in self._directory.iterdir():
            with suppress(FileNotFoundError):
                state = path.stat()
                entries.append((state.st_mtime_ns, state.st_size, path))
        excess = sum(size for _, size, _ in entries) - self._limit
        for _, size, path in sorted(entries):
            if excess <= 0:
                return
            if path != newest:
                with suppress(OSError):
                    path.unlink()
                excess -= size
