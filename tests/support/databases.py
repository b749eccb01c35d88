"""Tests that run with a registry in SQLite and in PostgreSQL."""

from collections.abc import Callable
from pathlib import Path

import pytest
from sqlalchemy import func, insert, select, text

from league.registry.registry import Registry
from league.registry.storage.tables import Base
from league.settings import Storage

StorageAt = Callable[[Path], Storage]

on_both_databases = pytest.mark.both_databases
"""Mark of a test, or of a module: the fixture `storage_at` creates registries in each database."""


def copy_rows(source: Registry, target: Registry) -> None:
    """Copy all rows of a registry to an empty one, with another database."""
    with source.database.engine.connect() as rows, target.database.engine.begin() as connection:
        for table in Base.metadata.sorted_tables:
            if contents := [dict(row) for row in rows.execute(select(table)).mappings()]:
                connection.execute(insert(table), contents)
            if table.autoincrement_column is not None and connection.dialect.name == "postgresql":
                column = table.autoincrement_column
                sequence = func.pg_get_serial_sequence(text(f"'{table.name}'"), text(f"'{column.name}'"))
                following = func.coalesce(select(func.max(column)).scalar_subquery(), 0) + 1
                connection.execute(select(func.setval(sequence, following, False)))
