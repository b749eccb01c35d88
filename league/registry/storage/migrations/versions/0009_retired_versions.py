"""Versions whose files were removed."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"


def upgrade() -> None:
    """Adds a column."""
    op.add_column("versions", sa.Column("retired_at", sa.DateTime(timezone=True), nullable=True))
