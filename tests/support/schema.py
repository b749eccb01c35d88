"""The statements of the migrations, which most tests execute again in their empty databases."""

from collections.abc import Callable
from functools import wraps
from typing import Any

from sqlalchemy import Connection, event

from league.registry.storage import database

Migrate = Callable[[Connection], None]


def migrated_once(migrate: Migrate) -> Migrate:
    """`migrate`, run once for each kind of database: later empty ones execute the statements that it executed."""
    statements: dict[str, list[str]] = {}

    @wraps(migrate)
    def applied(connection: Connection) -> None:
        kind = connection.dialect.name
        if database.revision(connection) is not None:
            migrate(connection)
        elif kind in statements:
            for statement in statements[kind]:
                connection.exec_driver_sql(statement)
        else:
            executed: list[str] = []

            def record(_: Connection, __: Any, statement: str, parameters: Any, *___: Any) -> None:
                if not statement.lstrip().upper().startswith(("SELECT", "PRAGMA")):
                    assert not parameters, f"{statement} has parameters {parameters}"
                    executed.append(statement)

            event.listen(connection, "before_cursor_execute", record)
            try:
                migrate(connection)
            finally:
                event.remove(connection, "before_cursor_execute", record)
            statements[kind] = executed

    return applied
