"""Alembic's entry: runs the migrations inside the transaction that schema.py holds."""

from alembic import context

from league.registry.tables import Table

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=Table.metadata,
    render_as_batch=True,
)
context.run_migrations()
