"""A lock between processes, which is released when its holder ends for any reason.

With SQLite, all processes run on one machine and share a lock file. With PostgreSQL, they share an advisory lock.
"""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout
from sqlalchemy import Engine, text
from sqlalchemy.exc import DBAPIError

from league.errors import AlreadyRunning, StorageError


@contextmanager
def hold(engine: Engine, home: Path, name: str) -> Iterator[None]:
    """Hold the lock `name`. Raises AlreadyRunning if another process holds it, StorageError if locking fails."""
    held = _in_database(engine, name) if engine.dialect.name == "postgresql" else _in_file(home, name)
    with held:
        yield


@contextmanager
def _in_file(home: Path, name: str) -> Iterator[None]:
    path = home / "locks" / f"{name}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(path, timeout=0).acquire()
    except Timeout as error:
        raise _running(name, str(path)) from error
    except OSError as error:
        raise StorageError(f"{path} cannot be locked: {error.strerror}") from error
    with lock:
        yield


@contextmanager
def _in_database(engine: Engine, name: str) -> Iterator[None]:
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        # Advisory locks are 64-bit numbers per database and last as long as the connection.
        scope = f"{connection.scalar(text('SELECT current_schema()'))}/{name}"
        key = int.from_bytes(hashlib.sha256(scope.encode()).digest()[:8], signed=True)
        if not connection.scalar(text("SELECT pg_try_advisory_lock(:key)"), {"key": key}):
            raise _running(name, "the database's advisory lock")
        try:
            yield
        finally:
            # The lock of a lost connection is already released.
            with suppress(DBAPIError):
                connection.execute(text("SELECT pg_advisory_unlock(:key)"), {"key": key})


def _running(name: str, holds: str) -> AlreadyRunning:
    return AlreadyRunning(f"another process is running {name} (it holds {holds})")
