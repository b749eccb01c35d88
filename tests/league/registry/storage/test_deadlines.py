"""Changes are applied before their deadline or not at all, and repeated after a deadlock."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from sqlalchemy import text
from sqlalchemy.orm import Session

from league.errors import DeadlineExceeded, InvalidReference, StorageError
from league.registry.registry import Registry
from league.registry.storage.database import Database, Deadlock, Repository, before, writing
from tests.support.databases import on_both_databases
from tests.support.leagues.registries import LEAGUE, promote, registered
from tests.support.waiting import until

pytestmark = on_both_databases


@pytest.fixture
def served(empty: Registry) -> Registry:
    """A league with two versions, of which the first is the champion."""
    registry = registered(empty, LEAGUE, versions=2)
    promote(registry, 1)
    return registry


@contextmanager
def locked(registry: Registry) -> Iterator[None]:
    """Another connection holds the lock that changes of the league wait for."""
    other = Registry.open(registry.storage)
    with other.database.write() as session:
        session.execute(text("UPDATE leagues SET slug = slug"))
        yield
    other.close()


def test_a_transaction_that_ends_after_its_deadline_is_rolled_back(served: Registry) -> None:
    deadline = time.monotonic() + 0.1

    def change() -> None:
        with served.database.write() as session:
            session.execute(text("UPDATE aliases SET version = 2"))
            until(lambda: time.monotonic() > deadline)

    with before(deadline), pytest.raises(DeadlineExceeded):
        change()
    assert served.aliases.current(LEAGUE) == {"champion": 1}


def test_an_invalid_argument_is_reported_before_the_database_is_used(served: Registry) -> None:
    with before(time.monotonic()), pytest.raises(InvalidReference):
        served.aliases.set(LEAGUE, "-first", 1, expected=None, actor="ada", reason="a name")


def test_deadlines_do_not_outlast_their_block(served: Registry) -> None:
    """With SQLite, the timeout of a lock belongs to the connection."""
    with before(time.monotonic() + 5):
        promote(served, 2)
    with ThreadPoolExecutor() as pool, locked(served):
        change = pool.submit(promote, served, 1)
        time.sleep(0.05)
        assert not change.done()
    assert served.aliases.current(LEAGUE) == {"champion": 1}


def test_a_change_waits_for_a_lock_until_its_deadline(served: Registry) -> None:
    with locked(served), pytest.raises((StorageError, DeadlineExceeded)), before(time.monotonic() + 0.1):
        promote(served, 2)
    with before(time.monotonic()), pytest.raises(DeadlineExceeded, match="nothing was changed"):
        promote(served, 2)
    assert served.aliases.current(LEAGUE) == {"champion": 1}
    promote(served, 2)
    assert served.aliases.current(LEAGUE) == {"champion": 2}


class Swaps(Repository):
    """Updates the alias and the league, in either order."""

    barrier = threading.Barrier(2, timeout=30)
    attempts = 0

    @writing
    def update(self, session: Session, first: str, second: str, wait: list[bool]) -> None:
        """Update two columns, and wait between them at the first attempt only."""
        session.execute(text(f"UPDATE {first}"))
        type(self).attempts += 1
        if wait:
            wait.pop()
            self.barrier.wait()
        session.execute(text(f"UPDATE {second}"))

    @writing
    def fail(self, session: Session) -> None:
        """Raise as after a deadlock."""
        session.execute(text("SELECT 1"))
        type(self).attempts += 1
        raise Deadlock("deadlock detected")


def test_a_deadlock_is_resolved_by_one_repetition(served: Registry) -> None:
    if served.database.engine.dialect.name == "sqlite":
        pytest.skip("SQLite runs one write transaction at a time")
    database = Database(f"{served.storage.database_url}%20-c%20deadlock_timeout%3D50ms")
    swaps, columns = Swaps(database), ["leagues SET slug = slug", "aliases SET version = version"]
    with ThreadPoolExecutor() as pool:
        for change in [pool.submit(swaps.update, *order, [True]) for order in (columns, columns[::-1])]:
            change.result()
    assert Swaps.attempts == 3
    with pytest.raises(StorageError, match="deadlock detected"):
        swaps.fail()
    assert Swaps.attempts == 3 + 2, "a second one is reported"
