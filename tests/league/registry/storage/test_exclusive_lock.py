"""A lock is held by one process until it ends, and a lock that is lost ends the work of its holder."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import text

from league.errors import AlreadyRunning, StorageError
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.databases import on_both_databases
from tests.support.leagues.registries import LEAGUE, promote, registered
from tests.support.waiting import until

HOLDERS = "SELECT pid FROM pg_locks WHERE locktype = 'advisory' AND granted"


def champion(registry: Registry) -> int | None:
    return registry.aliases.current(LEAGUE).get("champion")


def terminate_holder(registry: Registry) -> None:
    with registry.database.write() as session:
        database = "database = (SELECT oid FROM pg_database WHERE datname = current_database())"
        # With a timeout, it returns after the process has ended and released its locks.
        end = f"SELECT pg_terminate_backend(pid, 60000) FROM ({HOLDERS} AND {database}) AS holders"
        ended = session.execute(text(end))
        assert len(ended.all()) == 1


def test_changes_are_made_while_the_lock_is_held(registry: Registry) -> None:
    with registry.exclusive_lock("nightly"):
        for version in (1, 2):
            promote(registry, version)
            assert champion(registry) == version
        with pytest.raises(AlreadyRunning), Registry.open(registry.storage).exclusive_lock("nightly"):
            pass
    promote(registry, 3)
    with registry.exclusive_lock("nightly"):
        pass


HOLDER = """
import sys
from league.registry.registry import Registry
from league.settings import Storage
from pathlib import Path
storage = Storage(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
with Registry.open(storage).exclusive_lock("nightly-chess"):
    print("held", flush=True)
    sys.stdin.read()
"""


@on_both_databases
def test_one_process_holds_the_lock_until_it_exits(storage: Storage) -> None:
    registry = Registry.open(storage)
    command = [sys.executable, "-c", HOLDER, str(storage.home), storage.database_url, str(storage.artifacts)]

    def is_free() -> bool:
        try:
            with registry.exclusive_lock("nightly-chess"):
                return True
        except AlreadyRunning:
            return False

    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with (
            pytest.raises(AlreadyRunning, match="another process is running nightly-chess"),
            registry.exclusive_lock("nightly-chess"),
        ):
            pass
        with registry.exclusive_lock("nightly-go"):
            pass
        holder.kill()
        holder.wait()
    until(is_free)  # a server notices within moments that the connection of its holder is gone
    with (
        registry.exclusive_lock("nightly-chess"),
        pytest.raises(AlreadyRunning),
        Registry.open(storage).exclusive_lock("nightly-chess"),
    ):
        pass


@pytest.fixture
def registry(postgresql_storage: Storage) -> Registry:
    """With SQLite, only the end of the process releases the lock."""
    return registered(Registry.open(postgresql_storage), LEAGUE, versions=3)


def test_a_holder_that_lost_its_lock_changes_nothing(registry: Registry) -> None:
    other = Registry.open(registry.storage)
    with registry.exclusive_lock("nightly"):
        with registry.exclusive_lock("snapshots"):  # an inner one does not release the outer one
            promote(registry, 1)
        terminate_holder(other)
        with other.exclusive_lock("nightly"):
            promote(other, 2)
            for _ in range(3):
                with pytest.raises(StorageError):
                    promote(registry, 3)
            assert champion(registry) == 2, "reading continues"
        with ThreadPoolExecutor(1) as thread:  # other threads are unaffected
            thread.submit(promote, registry, 1).result()
        assert champion(registry) == 1
    promote(registry, 3)
    assert champion(other) == 3


def test_a_transaction_during_which_the_lock_is_lost_is_rolled_back(registry: Registry) -> None:
    other = Registry.open(registry.storage)
    promote(registry, 1)

    def change() -> None:
        with registry.database.write() as session:
            session.execute(text("UPDATE aliases SET version = 2"))
            terminate_holder(other)

    with registry.exclusive_lock("nightly"), pytest.raises(StorageError):
        change()
    assert champion(other) == 1
