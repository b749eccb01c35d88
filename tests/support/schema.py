"""The schema of a migrated SQLite database, applied to the empty databases of most tests."""

from collections.abc import Callable
from functools import wraps

from sqlalchemy import Connection

from league.registry.storage import database

Migrate = Callable[[Connection], None]


def migrated_once(migrate: Migrate) -> Migrate:
    """`migrate`, run once: later empty SQLite databases execute the resulting schema statements."""
    statements: list[str] = []

    @wraps(migrate)
    def applied(connection: Connection) -> None:
        if connection.dialect.name != "sqlite" or database.revision(connection) is not None:
            migrate(connection)
        elif statements:
            for statement in statements:
                connection.exec_driver_sql(statement)
        else:
            migrate(connection)
            query = "SELECT sql FROM sqlite_master WHERE sql IS NOT NULL AND name NOT LIKE 'sqlite_%' ORDER BY rowid"
            statements.extend(connection.exec_driver_sql(query).scalars())
            statements.append(f"INSERT INTO alembic_version VALUES ('{database.revision(connection)}')")

    return applied
