"""A lock between processes, which is released when its holder ends for any reason.

With SQLite, all processes run on one machine and share a lock file. With PostgreSQL, they share an advisory lock.
"""

import hashlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError

from league.errors import AlreadyRunning, StorageError
from league.registry.storage.database import Database, translate_errors


def hold(database: Database, home: Path, name: str) -> AbstractContextManager[None]:
    """Hold the lock `name`. Raises AlreadyRunning if another process holds it, StorageError if locking fails.

    If the lock is lost, because the connection to PostgreSQL ends, all further changes by this thread fail with
    StorageError: another process may hold the lock.
    """
    return _in_file(home, name) if database.is_sqlite else _in_database(database, name)


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
def _in_database(database: Database, name: str) -> Iterator[None]:
    with translate_errors(database.engine), database.engine.connect() as connection:
        # Advisory locks are 64-bit numbers per database and last as long as the connection.
        scope = f"{connection.scalar(text('SELECT current_schema()'))}/{name}"
        key = int.from_bytes(hashlib.sha256(scope.encode()).digest()[:8], signed=True)
        is_free = connection.scalar(text("SELECT pg_try_advisory_lock(:key)"), {"key": key})
        connection.commit()
        if not is_free:
            raise _running(name, "the database's advisory lock")
        try:
            # A change that is committed through this connection was made while the lock was held.
            with database.through(connection):
                yield
        finally:
            # The lock of a lost connection is already released.
            with suppress(DBAPIError):
                if not connection.invalidated:
                    connection.execute(text("SELECT pg_advisory_unlock(:key)"), {"key": key})
                    connection.commit()


def _running(name: str, holds: str) -> AlreadyRunning:
    return AlreadyRunning(f"another process is running {name} (it holds {holds})")
