"""A connection that PostgreSQL notifies of changes."""

import os
import select
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text

from league.errors import StorageError
from league.registry.registry import Registry
from league.registry.storage.database import Database
from league.registry.storage.listener import Listener
from league.settings import Storage

SECONDS = 30


@pytest.fixture
def registry(postgresql_storage: Storage) -> Iterator[Registry]:
    registry = Registry.open(postgresql_storage)
    yield registry
    registry.close()


@pytest.fixture
def listening(registry: Registry) -> Iterator[Database]:
    database = Database(registry.storage.database_url, listens=True)
    yield database
    database.close()


def listener_of(database: Database) -> Listener:
    assert database.listener is not None
    return database.listener


def is_readable(listener: Listener, seconds: float) -> bool:
    socket = listener.socket()
    assert socket is not None
    try:
        waiting = select.poll()  # select() does not accept the numbers of files after the 1,024th
        waiting.register(socket, select.POLLIN)
        return bool(waiting.poll(seconds * 1000))
    finally:
        os.close(socket)


def test_a_notification_during_a_statement_is_reported(registry: Registry, listening: Database) -> None:
    listener, notified = listener_of(listening), []
    assert not is_readable(listener, 0)
    listener.on_change = lambda: notified.append(True)
    registry.keys.create("bot", ["act"])
    assert is_readable(listener, SECONDS)
    for transaction in (listening.read, listening.write):
        with transaction() as session:
            session.execute(text("SELECT 1"))
    assert notified == [True]
    assert not is_readable(listener, 0)
    assert listener.opened == 1


def test_a_lost_connection_is_replaced_by_one_that_listens(registry: Registry, listening: Database) -> None:
    listener = listener_of(listening)
    with listening.read() as session:
        process = session.scalar(text("SELECT pg_backend_pid()"))
    with registry.database.write() as session:
        session.execute(text("SELECT pg_terminate_backend(:process)"), {"process": process})
    assert is_readable(listener, SECONDS), "a replica must notice"
    with pytest.raises(StorageError), listening.read() as session:
        session.execute(text("SELECT 1"))
    assert listener.socket() is None
    with listening.read() as session:
        session.execute(text("SELECT 1"))
    assert listener.opened == 2
    registry.keys.create("bot", ["act"])
    assert is_readable(listener, SECONDS)


def test_sqlite_does_not_notify(tmp_path: Path) -> None:
    database = Database(Storage.at(tmp_path).database_url, listens=True)
    assert listener_of(database).socket() is None
    assert listener_of(database).opened == 1
    database.close()


def test_pooled_connections_are_closed_when_they_are_not_used(registry: Registry) -> None:
    registry.leagues.names()
    registry.database.close_unused()
    assert registry.database.engine.pool.checkedin() == 1, "it was used since the last call"
    registry.database.close_unused()
    assert registry.database.engine.pool.checkedin() == 0
    assert registry.leagues.names() == {}


def test_discarded_notifications_are_not_seen_again(registry: Registry, listening: Database) -> None:
    listener = listener_of(listening)
    notifications = list[None]()
    listener.on_change = lambda: notifications.append(None)
    listener.discard()  # without a connection
    registry.keys.create("bot", ["act"])
    with listening.read() as session:
        session.execute(text("SELECT 1"))
    registry.keys.create("another", ["act"])
    assert is_readable(listener, SECONDS)
    notifications.clear()
    listener.discard()
    assert not is_readable(listener, 0)
    with listening.read() as session:
        session.execute(text("SELECT 1"))
    assert notifications == []
