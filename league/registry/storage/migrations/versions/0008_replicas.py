"""Replicas that have started, and the alias event that an acknowledgement follows."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Adds a table and a column."""
    op.create_table(
        "replicas",
        sa.Column("replica", sa.String(length=255), nullable=False),
        sa.Column("process", sa.JSON(), nullable=False),
        sa.Column("seen_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("replica", name=op.f("pk_replicas")),
    )
    op.add_column("acknowledgements", sa.Column("event", sa.Integer(), nullable=True))
