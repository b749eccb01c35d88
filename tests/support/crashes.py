"""Simulated deaths of a process between transactions."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from sqlalchemy.orm import Session

from league.registry.storage.database import Database


class ProcessDeath(BaseException):
    """Simulates the death of the process."""


@contextmanager
def crash_after(writes: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Crash after the `writes`-th transaction; yields a counter of the transactions."""
    original, count, caller = Database.write, [0], threading.get_ident()

    @contextmanager
    def write(database: Database) -> Iterator[Session]:
        with original(database) as session:
            yield session
        if threading.get_ident() != caller:
            return  # replicas of other tests report their metrics from threads of this process
        count[0] += 1
        if count[0] == writes:
            raise ProcessDeath

    with monkeypatch.context() as patch:
        patch.setattr(Database, "write", write)
        yield count
