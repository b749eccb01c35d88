"""Leagues that are archived."""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"


def upgrade() -> None:
    """Adds a column."""
    op.add_column("leagues", sa.Column("archived_at", sa.DateTime(timezone=True), nullable=True))
