"""Database of the registry and the ledger: engine, transactions, migrations and error translation."""

import json
import logging
import os
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from functools import wraps
from importlib import import_module
from inspect import Parameter, signature
from pathlib import Path
from types import ModuleType
from typing import Any, Concatenate, ParamSpec, TypeVar
from urllib.parse import quote

from filelock import FileLock
from sqlalchemy import (
    URL,
    CompoundSelect,
    Connection,
    CursorResult,
    Engine,
    Executable,
    Select,
    UpdateBase,
    create_engine,
    event,
    func,
    inspect,
    make_url,
    select,
    text,
)
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

from league.errors import ConfigError, DeadlineExceeded, InvalidInput, StorageError, one_line
from league.files import disk_errors, full_disk
from league.registry.storage.listener import Listener
from league.registry.storage.migrations import HEAD, KNOWN
from league.registry.storage.tables import Base

LOCK = 5_246_001
"""Key of PostgreSQL's advisory lock."""
LOCK_SECONDS = 60
"""Timeout for an upgrade by another process."""


def upgrade(engine: Engine) -> None:
    """Apply the missing migrations, all or none. If none is missing, Alembic is not imported.

    Raises StorageError if another release has created the database, with tables that this one does not know.
    """
    with engine.connect() as connection:
        if revision(connection) == HEAD:
            return
    with _exclusive(engine) as connection:
        current = revision(connection)
        if current not in (None, *KNOWN):
            raise StorageError(f"the database has the schema {current} of another release: install that one")
        if current != HEAD:
            _apply(connection)


def revision(connection: Connection) -> str | None:
    """Return the last applied migration, None for an empty database."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    return connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one_or_none()


@contextmanager
def _exclusive(engine: Engine) -> Iterator[Connection]:
    """A write transaction that excludes upgrades by other processes."""
    writing = engine.execution_options(writes=True)
    if engine.dialect.name == "postgresql":
        with writing.begin() as connection:
            connection.execute(text(f"SET LOCAL lock_timeout = '{LOCK_SECONDS}s'"))
            connection.execute(text("SET LOCAL statement_timeout = 0"))
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": LOCK})
            yield connection
        return
    lock = Path(f"{engine.url.database}.lock")
    with disk_errors(lock), FileLock(lock, timeout=LOCK_SECONDS):
        # The mode is stored in the file. SQLite does not change it inside a transaction, hence the raw connection.
        with closing(engine.raw_connection()) as raw:
            raw.cursor().execute("PRAGMA journal_mode = WAL")
        with writing.begin() as connection:
            yield connection


def _apply(connection: Connection) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).with_name("migrations")).replace("%", "%%"))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


BUSY_TIMEOUT_SECONDS = 30
"""Timeout of a transaction that waits for one of another process."""
CONNECTION_DEFAULTS = {
    "connect_timeout": "3",  # seconds
    "tcp_user_timeout": "5000",  # milliseconds; without it Linux repeats lost packets for a quarter of an hour
    "keepalives_idle": "5",
    "keepalives_interval": "2",
    "keepalives_count": "3",
}
"""Parameters of a PostgreSQL connection, unless the URL has them: a lost connection is noticed within seconds."""
SESSION_DEFAULTS = "-c statement_timeout=30s -c lock_timeout=10s"
"""Settings of a PostgreSQL session, unless the URL's `options` have them."""
FILE = "file"
"""Key in a connection's `info`: its open file by device and inode."""
DEADLOCKS = ("40P01", "40001")
"""Codes of PostgreSQL for deadlock_detected and serialization_failure."""
DEADLOCK_PAUSE = 0.05
"""Seconds."""
STORAGE_ERRORS = (OperationalError, DatabaseError, InterfaceError, InternalError)
"""Disk full, read-only, locked, not a database, no server. Other errors, such as constraints, are not translated."""


P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R", bound="Repository")


class Deadlock(StorageError):
    """One of several transactions that waited for each other was ended. It can be repeated."""


class Database:
    """Sessions on the registry's database. Opening it upgrades the schema."""

    def __init__(self, url: str, create: bool = True, listens: bool = False) -> None:
        """Open the database. Raises StorageError or ConfigError.

        create: create an SQLite file that does not exist. listens: use one connection, which PostgreSQL notifies of
        changes; for one thread.
        """
        self.engine = _engine(url, create, listens)
        self.listener = Listener(self.engine) if listens else None
        # Each statement of PostgreSQL has a snapshot of its own also in a transaction, so that one would only add
        # statements; SQLite has a snapshot per transaction.
        self._reading = self.engine if self.is_sqlite else self.engine.execution_options(isolation_level="AUTOCOMMIT")
        self._writing = self.engine.execution_options(writes=True)
        self._is_unused = True
        event.listen(self.engine, "checkout", self._note_use)
        self.engine.pool.logger.addFilter(_is_no_interrupt)  # type: ignore[union-attr]
        self._of_thread = threading.local()
        try:
            with translate_errors(self.engine):
                upgrade(self.engine)
        except BaseException:
            self.close()
            raise

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A read-only transaction, which never waits for a lock."""
        with translate_errors(self.engine), Session(self._reading, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A transaction that is committed at the end, or rolled back on an error. SQLite runs one at a time.

        Raises DeadlineExceeded, and changes nothing, if that of `before` passes.
        """
        deadline = _deadline.get()
        connection: Connection | None = getattr(self._of_thread, "connection", None)
        if connection is not None and connection.invalidated:
            # SQLAlchemy would connect again, without the locks of the session.
            raise StorageError("the connection to the database was lost, and with it a lock that this work requires")
        with (
            translate_errors(self.engine),
            Session(connection or self._writing, expire_on_commit=False) as session,
            session.begin(),
        ):
            if deadline is not None and self.engine.dialect.name == "postgresql":
                # Like SQLite's timeout, with the first statement: until then, the database is not used.
                event.listen(session, "after_begin", lambda *begun: _limit_waiting(begun[-1], deadline))
            yield session
            if deadline is not None:
                _milliseconds_until(deadline)

    @property
    def is_sqlite(self) -> bool:
        """Whether this is SQLite, which has no clock: all its clients run on one machine."""
        return self.engine.dialect.name == "sqlite"

    def rows(self, query: Select[*tuple[Any, ...]] | CompoundSelect[*tuple[Any, ...]]) -> Sequence[Any]:
        """Return the rows of one query. It costs a fraction of a session: for what replicas read again and again."""
        with translate_errors(self.engine), self._reading.connect() as connection:
            return connection.execute(query).all()

    def execute(self, statement: UpdateBase, values: Mapping[str, Any]) -> int:
        """Execute one statement, commit it, and return the number of its rows. It costs a fraction of a session."""
        # With PostgreSQL, a single statement is a transaction of its own.
        begin = self._reading.connect if self.engine.dialect.name == "postgresql" else self._writing.begin
        with translate_errors(self.engine), begin() as connection:
            return connection.execute(statement, values).rowcount

    @contextmanager
    def through(self, connection: Connection) -> Iterator[None]:
        """Use one connection for all write transactions of this thread. If it is lost, they fail from then on."""
        previous = getattr(self._of_thread, "connection", None)
        self._of_thread.connection = connection
        try:
            yield
        finally:
            self._of_thread.connection = previous

    def close_unused(self) -> None:
        """Close pooled connections to PostgreSQL, each a process there, if none was used since the last call."""
        is_unused, self._is_unused = self._is_unused, True
        if self.engine.dialect.name == "postgresql" and is_unused:
            self.engine.dispose()

    def close(self) -> None:
        """Close the connections."""
        self.engine.dispose()

    def _note_use(self, *_: object) -> None:
        self._is_unused = False


_deadline: ContextVar[float | None] = ContextVar("deadline", default=None)


@contextmanager
def before(deadline: float) -> Iterator[None]:
    """Apply changes only before a deadline, a time of `time.monotonic`: later, nobody waits for the result."""
    token = _deadline.set(deadline)
    try:
        yield
    finally:
        _deadline.reset(token)


def _limit_waiting(connection: Connection, deadline: float) -> None:
    connection.exec_driver_sql(f"SET LOCAL lock_timeout = {_milliseconds_until(deadline)}")


def _milliseconds_until(deadline: float) -> int:
    if (seconds := deadline - time.monotonic()) <= 0:
        raise DeadlineExceeded("the database was busy until the deadline: nothing was changed")
    return max(1, int(1000 * seconds))


class Repository:
    """Base of the repositories. Each public method is one transaction: `reading`, `writing` or `as_method`."""

    def __init__(self, database: Database) -> None:
        self._database = database


def reading(method: Callable[Concatenate[R, Session, P], T]) -> Callable[Concatenate[R, P], T]:
    """Call a method of a repository with the session of a read-only transaction, which is its first argument."""

    @wraps(method)
    def call(self: R, /, *args: P.args, **kwargs: P.kwargs) -> T:
        with self._database.read() as session:
            return method(self, session, *args, **kwargs)

    return _as_callers_see(call)


def writing(method: Callable[Concatenate[R, Session, P], T]) -> Callable[Concatenate[R, P], T]:
    """Call a method of a repository with the session of a write transaction, which is its first argument.

    The transaction begins with the method's first statement: what precedes it holds no lock, and an invalid argument is
    reported even if the database cannot be reached.

    If PostgreSQL has ended the transaction to resolve a deadlock, the method is called once more. The other transaction
    gets DEADLOCK_PAUSE to take the locks that this one has lost. Without it, both could end in the same deadlock again.
    """

    def attempt(self: R, *args: P.args, **kwargs: P.kwargs) -> T:
        with self._database.write() as session:
            return method(self, session, *args, **kwargs)

    @wraps(method)
    def call(self: R, /, *args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return attempt(self, *args, **kwargs)
        except Deadlock:
            time.sleep(DEADLOCK_PAUSE)
            return attempt(self, *args, **kwargs)

    return _as_callers_see(call)


def as_method(function: Callable[Concatenate[Session, P], T]) -> Callable[Concatenate[Repository, P], T]:
    """Return a method that is `reading`, of a function that is also a part of other transactions."""

    @wraps(function)
    def call(_: Repository, session: Session, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return function(session, *args, **kwargs)

    return reading(call)


def _as_callers_see(call: Callable[P, T]) -> Callable[P, T]:
    """Give a method the signature without the session, for `help`."""
    original = signature(call)
    parameters = list(original.parameters.values())[list(original.parameters).index("session") + 1 :]
    of_method = [Parameter("self", Parameter.POSITIONAL_ONLY), *parameters]
    vars(call)["__signature__"] = original.replace(parameters=of_method)
    return call


def insert(session: Session, table: type[Base], rows: Sequence[Mapping[str, Any]]) -> int:
    """Insert the rows whose primary key does not exist; returns their number."""
    if not rows:
        return 0
    statement = _dialect(session).insert(table.__table__).on_conflict_do_nothing()
    kept = {"preserve_rowcount": True}
    return session.connection().execute(statement, rows, execution_options=kept).rowcount


def row_count(session: Session, statement: Executable) -> int:
    """Execute a statement; returns the number of rows inserted, updated or deleted."""
    result = session.execute(statement)
    assert isinstance(result, CursorResult)
    return result.rowcount


def upsert(session: Session, table: type[Base], key: Mapping[str, Any], values: Mapping[str, Any]) -> None:
    """Insert a row, or update `values` of the row with this primary key."""
    statement = _dialect(session).insert(table).values(**key, **values)
    session.execute(statement.on_conflict_do_update(index_elements=list(key), set_=dict(values)))


def upsert_all(session: Session, table: type[Base], key: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Insert rows, or update those with the same primary key. key: the columns of the primary key."""
    if not rows:
        return
    statement = _dialect(session).insert(table)
    values = {name: statement.excluded[name] for name in rows[0] if name not in key}
    session.execute(statement.on_conflict_do_update(index_elements=list(key), set_=values), rows)


def increment(session: Session, table: type[Base], key: Mapping[str, Any], column: str) -> None:
    """Add 1 to a column of the row with this primary key, which is inserted if it does not exist."""
    statement = _dialect(session).insert(table).values(**key, **{column: 1})
    later = {column: table.__table__.c[column] + 1}
    session.execute(statement.on_conflict_do_update(index_elements=list(key), set_=later))


def sql_clock(session: Session) -> Any:
    """Return the time of `clock` for use in a statement: PostgreSQL evaluates it without a statement of its own."""
    if session.get_bind().dialect.name == "sqlite":
        return datetime.now(UTC)
    return func.clock_timestamp()


def clock(session: Session) -> datetime:
    """Return the time of the database's clock, which all its clients share."""
    if session.get_bind().dialect.name == "sqlite":
        return datetime.now(UTC)  # all its clients run on one machine
    return session.execute(select(func.clock_timestamp())).scalar_one()


def _dialect(session: Session) -> ModuleType:
    """The dialect module with ON CONFLICT, which is equal in both databases but not standard SQL."""
    return import_module(f"sqlalchemy.dialects.{session.get_bind().dialect.name}")  # the other one takes 40 ms


@contextmanager
def translate_errors(engine: Engine) -> Iterator[None]:
    """Translate database failures into a StorageError of one line, and text that is not Unicode into InvalidInput."""
    try:
        yield
    except UnicodeEncodeError as error:
        raise InvalidInput(f"{error.object[:100]!r} is not valid text: it cannot be encoded as UTF-8") from error
    except DBAPIError as error:
        if type(error) not in STORAGE_ERRORS:
            raise
        where = engine.url.render_as_string(hide_password=True)
        reason = one_line(error.orig or error)
        if getattr(error.orig, "sqlite_errorname", "").startswith(("SQLITE_FULL", "SQLITE_IOERR")):
            # SQLite also reports the failure to extend a file as `disk I/O error`.
            reason = full_disk(Path(engine.url.database or "")) or reason
        kind = Deadlock if getattr(error.orig, "sqlstate", None) in DEADLOCKS else StorageError
        raise kind(f"the database {where} cannot be used: {reason}") from error


def _engine(url: str, create: bool, listens: bool) -> Engine:
    try:
        parsed = make_url(url)
    except ArgumentError:
        raise ConfigError("LEAGUE_DATABASE_URL is not a URL: expected sqlite:////path or postgresql://…") from None
    name = parsed.get_backend_name()
    if name not in ("sqlite", "postgresql"):
        raise ConfigError(f"LEAGUE_DATABASE_URL names {name!r}: expected sqlite or postgresql")
    if name == "postgresql":
        return _postgresql(parsed, listens)
    if not parsed.database or parsed.database == ":memory:":
        raise ConfigError(f"LEAGUE_DATABASE_URL {url!r} does not name a file: expected sqlite:////path/to/league.db")
    return _sqlite(url, Path(parsed.database), create)


def _sqlite(url: str, path: Path, create: bool) -> Engine:
    if create and not path.exists():
        with disk_errors(path):
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            path.touch(mode=0o600)  # it contains digests of API keys; SQLite gives its other files the same mode
    engine = create_engine(url, json_serializer=_strict_json, connect_args={"timeout": BUSY_TIMEOUT_SECONDS})
    event.listen(engine, "connect", _prepare_sqlite)

    @event.listens_for(engine, "do_connect")
    def open_existing(_: object, record: ConnectionPoolEntry, arguments: list[Any], options: dict[str, Any]) -> None:
        # A file created while the database is moved away would be mistaken for it and mixed with its write-ahead log.
        path = arguments[0]
        record.info[FILE] = path, _identity(path)
        if record.info[FILE][1] is None:
            raise StorageError(f"the database {path} does not exist")
        arguments[0] = f"file:{quote(path)}?{_access(path)}"
        options["uri"] = True

    @event.listens_for(engine, "checkout")
    def check_file(_: object, record: ConnectionPoolEntry, __: object) -> None:
        # A connection keeps its file open if that is moved or replaced.
        path, opened = record.info[FILE]
        if _identity(path) != opened:
            raise DisconnectionError(f"{path} was replaced by another file")

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        if not connection.get_execution_options().get("writes", False):
            connection.exec_driver_sql("BEGIN")
            return
        deadline = _deadline.get()
        timeout = 1000 * BUSY_TIMEOUT_SECONDS if deadline is None else _milliseconds_until(deadline)
        connection.exec_driver_sql(f"PRAGMA busy_timeout = {timeout}")
        connection.exec_driver_sql("BEGIN IMMEDIATE")

    return engine


def _access(path: str) -> str:
    """The parameters of SQLite's URI. A file that this user cannot write is only read."""
    if os.access(path, os.W_OK):
        return "mode=rw"
    # Without a write-ahead log, SQLite would create one to read the database.
    return "mode=ro" if os.path.exists(f"{path}-wal") else "mode=ro&immutable=1"


def _identity(path: str) -> tuple[int, int] | None:
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _postgresql(url: URL, listens: bool) -> Engine:
    options = " ".join([SESSION_DEFAULTS, *url.normalized_query.get("options", ())])
    query = CONNECTION_DEFAULTS | url.query | {"options": options}
    psycopg = url.set(drivername="postgresql+psycopg", query=query)
    # A connection that listens is used too often to be tested before each use.
    pool = {"pool_size": 1, "max_overflow": 0} if listens else {"pool_pre_ping": True}
    try:
        return create_engine(psycopg, json_serializer=_strict_json, **pool)
    except ModuleNotFoundError:
        raise ConfigError("PostgreSQL needs a driver: pip install 'policy-league[postgres]'") from None


def _is_no_interrupt(record: logging.LogRecord) -> bool:
    """Whether a record of the pool is not about the signal that ends this program, whose exception is raised, too."""
    return not record.exc_info or isinstance(record.exc_info[1], Exception)


def _strict_json(document: Any) -> str:
    """Reject NaN and infinity, which PostgreSQL does not accept."""
    return json.dumps(document, allow_nan=False)


def _prepare_sqlite(connection: sqlite3.Connection, _: object) -> None:
    # The driver begins transactions at the first write, which is too late to read under the lock.
    connection.isolation_level = None
    connection.execute("PRAGMA foreign_keys = ON")
