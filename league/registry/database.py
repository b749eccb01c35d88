"""One connection pool with two kinds of transaction, alike on SQLite and PostgreSQL."""

import json
import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import quote

from sqlalchemy import Connection, CursorResult, Engine, Executable, create_engine, event, make_url
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import (
    ArgumentError,
    DatabaseError,
    DBAPIError,
    DisconnectionError,
    InterfaceError,
    InternalError,
    OperationalError,
)
from sqlalchemy.orm import Session
from sqlalchemy.pool import ConnectionPoolEntry

from league.errors import ConfigError, InvalidInput, StorageError
from league.registry import schema
from league.registry.faults import disk_faults
from league.registry.tables import Table

BUSY_SECONDS = 30
"""How long a transaction waits for another process's before it gives up."""
FILE = "file"
"""In a connection's `info`: the file that it has open, by device and inode."""
STORAGE_FAULTS = (OperationalError, DatabaseError, InterfaceError, InternalError)
"""Disk full, read-only, locked, no database, no server. Others (a violated constraint) are for the caller."""


class Database:
    """Sessions on the registry's database, whose schema is the newest once this exists."""

    def __init__(self, url: str, create: bool = True) -> None:
        """create: make an SQLite file that is not there. Raises StorageError or ConfigError."""
        self.engine = _engine(url, create)
        self._writing = self.engine.execution_options(writes=True)
        try:
            with translated(self.engine):
                schema.upgrade(self.engine)
        except BaseException:
            self.close()
            raise

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A transaction that changes nothing and waits for nobody."""
        with translated(self.engine), Session(self.engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A transaction that is committed at the end, or leaves nothing. SQLite runs one at a time."""
        with (
            translated(self.engine),
            Session(self._writing, expire_on_commit=False) as session,
            session.begin(),
        ):
            yield session

    def close(self) -> None:
        """Give the connections back."""
        self.engine.dispose()


def insert(session: Session, table: type[Table], rows: Sequence[Mapping[str, Any]]) -> int:
    """Insert those of `rows` whose primary key is not there yet; returns how many those were."""
    if not rows:
        return 0
    statement = _dialect(session).insert(table.__table__).on_conflict_do_nothing()
    kept = {"preserve_rowcount": True}
    return session.connection().execute(statement, rows, execution_options=kept).rowcount


def affected(session: Session, statement: Executable) -> int:
    """Execute; returns how many rows were inserted, changed or removed."""
    result = session.execute(statement)
    assert isinstance(result, CursorResult)
    return result.rowcount


def upsert(session: Session, table: type[Table], key: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Insert a row, or replace `values` of the row that has this primary key."""
    statement = _dialect(session).insert(table).values(**key, **values)
    session.execute(statement.on_conflict_do_update(index_elements=list(key), set_=dict(values)))


def _dialect(session: Session) -> ModuleType:
    """The part of SQLAlchemy that knows ON CONFLICT: it is alike in both databases, but no standard."""
    return postgresql if session.get_bind().dialect.name == "postgresql" else sqlite


@contextmanager
def translated(engine: Engine) -> Iterator[None]:
    """Turn a fault of the database itself into a StorageError of one line, and what is no text into InvalidInput."""
    try:
        yield
    except UnicodeEncodeError as error:
        raise InvalidInput(f"{error.object[:100]!r} is no text: it cannot be written as UTF-8") from error
    except DBAPIError as error:
        if type(error) not in STORAGE_FAULTS:
            raise
        where = engine.url.render_as_string(hide_password=True)
        reason = " ".join(str(error.orig).split())
        raise StorageError(f"the database {where} cannot be used: {reason}") from error


def _engine(url: str, create: bool) -> Engine:
    try:
        parsed = make_url(url)
    except ArgumentError:
        raise ConfigError(f"LEAGUE_DATABASE_URL {url!r} is no database URL") from None
    name = parsed.get_backend_name()
    if name not in ("sqlite", "postgresql"):
        raise ConfigError(f"LEAGUE_DATABASE_URL names {name!r}: expected sqlite or postgresql")
    if name == "postgresql":
        return _postgresql(url)
    if not parsed.database or parsed.database == ":memory:":
        raise ConfigError(f"LEAGUE_DATABASE_URL {url!r} names no file: expected sqlite:////path/to/league.db")
    return _sqlite(url, Path(parsed.database), create)


def _sqlite(url: str, path: Path, create: bool) -> Engine:
    if create:
        with disk_faults(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    engine = create_engine(url, json_serializer=_strict_json, connect_args={"timeout": BUSY_SECONDS})
    event.listen(engine, "do_connect", _open_existing)
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "checkout", _refuse_moved)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _open_existing(
    _: object, record: ConnectionPoolEntry, arguments: list[Any], options: dict[str, Any]
) -> sqlite3.Connection | None:
    """Never make a file: one that is made while the database is elsewhere would be taken for it, and be mixed with its
    write-ahead log."""
    path = arguments[0]
    record.info[FILE] = path, _identity(path)
    if record.info[FILE][1] is None:
        raise StorageError(f"the database {path} is not there")
    arguments[0] = f"file:{quote(path)}?mode=rw"
    options["uri"] = True
    return None


def _refuse_moved(_: object, record: ConnectionPoolEntry, __: object) -> None:
    """A connection stays with its file when that is moved away or replaced: then open what has that name now."""
    path, opened = record.info[FILE]
    if _identity(path) != opened:
        raise DisconnectionError(f"{path} is another file by now")


def _identity(path: str) -> tuple[int, int] | None:
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _postgresql(url: str) -> Engine:
    psycopg = make_url(url).set(drivername="postgresql+psycopg")
    try:
        return create_engine(psycopg, json_serializer=_strict_json, pool_pre_ping=True)
    except ModuleNotFoundError:
        raise ConfigError("PostgreSQL needs a driver: pip install 'policy-league[postgres]'") from None


def _strict_json(document: Any) -> str:
    """PostgreSQL takes no NaN and no infinity, so SQLite gets none either."""
    return json.dumps(document, allow_nan=False)


def _prepare_sqlite(connection: sqlite3.Connection, _: object) -> None:
    # The driver's own transactions begin at the first write only, too late to have read under the lock.
    connection.isolation_level = None
    connection.execute("PRAGMA foreign_keys = ON")


def _begin_sqlite(connection: Connection) -> None:
    writes = connection.get_execution_options().get("writes", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
