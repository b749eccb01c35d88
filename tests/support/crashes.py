"""Simulated deaths of a process between transactions."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sqlalchemy.orm import Session

from league.registry.registry import Registry
from league.registry.storage.database import Database
from tests.support.templates import copied


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


def after_crashes(
    home: Path, run: Callable[[Registry], object], every: int, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[int, Registry]]:
    """Copies of the league in a home, with the transaction after which `run` died in it, before it was repeated: each
    `every`-th one, from the last on. The first copy is one in which it has ended, with the number of its transactions.
    """
    with copied(home, home.with_name("quiet")) as registry:
        with crash_after(0, monkeypatch) as count:
            run(registry)
        yield count[0], registry
    for crash_at in range(count[0], 0, -every):
        with copied(home, home.with_name(str(crash_at))) as registry:
            with crash_after(crash_at, monkeypatch), pytest.raises(ProcessDeath):
                run(registry)
            run(registry)
            yield crash_at, registry
