"""The change counter, and what a replica has read, in its own row."""

import sqlalchemy as sa
from alembic import op

revision = "0017"
down_revision = "0016"


def upgrade() -> None:
    """Adds a table, three columns and an index."""
    op.create_table(
        "change_counter",
        sa.Column("id", sa.Integer(), nullable=False, autoincrement=False),
        sa.Column("aliases", sa.BigInteger(), nullable=False, server_default="0"),
        sa.Column("traffic", sa.BigInteger(), nullable=False, server_default="0"),
        sa.Column("keys", sa.BigInteger(), nullable=False, server_default="0"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_change_counter")),
    )
    op.add_column("replicas", sa.Column("event", sa.Integer(), nullable=True))
    op.add_column("replicas", sa.Column("traffic", sa.Integer(), nullable=True))
    op.add_column("replicas", sa.Column("changes", sa.BigInteger(), nullable=True))
    op.create_index(op.f("ix_replicas_seen_at"), "replicas", ["seen_at"])
