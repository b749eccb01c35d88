"""Writing without waiting for the disk. What a killed process wrote is kept; only a power failure could lose it."""

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps

import pytest

from league.registry.storage import database

Prepare = Callable[[sqlite3.Connection, object], None]


@contextmanager
def without_syncing() -> Iterator[None]:
    """In this process, do not force files and transactions of SQLite to the disk."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "fsync", os.fstat)  # which also raises OSError for an invalid descriptor
        patched.setattr(database, "_prepare_sqlite", _unsynced(database._prepare_sqlite))
        yield


def _unsynced(prepare: Prepare) -> Prepare:
    @wraps(prepare)
    def prepared(connection: sqlite3.Connection, record: object) -> None:
        prepare(connection, record)
        connection.execute("PRAGMA synchronous = OFF")

    return prepared
