"""Brings a database to the newest schema: once, however many processes open it together."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock
from sqlalchemy import Connection, Engine, inspect, text

from league.errors import StorageError
from league.registry.faults import disk_faults
from league.registry.migrations import HEAD, KNOWN

LOCK = 5_246_001
"""The key of PostgreSQL's advisory lock."""
LOCK_SECONDS = 60
"""How long to wait for another process's upgrade of an SQLite file."""


def upgrade(engine: Engine) -> None:
    """Apply the missing migrations, all or none. Nearly free where none is missing: no Alembic is imported.

    Raises StorageError if the database was made by a newer release.
    """
    with engine.connect() as connection:
        if revision(connection) == HEAD:
            return
    with _alone(engine) as connection:
        current = revision(connection)
        if current not in (None, *KNOWN):
            raise StorageError(f"the database has the schema {current} of a newer release: upgrade this program")
        if current != HEAD:
            _apply(connection)


def revision(connection: Connection) -> str | None:
    """The last migration that was applied; None for an empty database."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    return connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one_or_none()


@contextmanager
def _alone(engine: Engine) -> Iterator[Connection]:
    """A write transaction that no other process's upgrade runs beside."""
    writing = engine.execution_options(writes=True)
    if engine.dialect.name == "postgresql":
        with writing.begin() as connection:
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": LOCK})
            yield connection
        return
    lock = Path(f"{engine.url.database}.lock")
    with disk_faults(lock), FileLock(lock, timeout=LOCK_SECONDS):
        _allow_readers_beside_a_writer(engine)
        with writing.begin() as connection:
            yield connection


def _allow_readers_beside_a_writer(engine: Engine) -> None:
    # The file remembers it. SQLite refuses it inside a transaction, hence the bare connection.
    connection = engine.raw_connection()
    try:
        connection.cursor().execute("PRAGMA journal_mode = WAL")
    finally:
        connection.close()


def _apply(connection: Connection) -> None:
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).with_name("migrations")).replace("%", "%%"))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")
