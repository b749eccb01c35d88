"""Entry point of Alembic: runs the migrations inside the transaction of `database.upgrade`."""

from alembic import context

from league.registry.storage import rows

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=rows.Record.metadata,
    render_as_batch=True,
)
context.run_migrations()
