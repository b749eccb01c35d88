"""Runs of algorithms of the user's code, whose entry points may be long."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Remove the bound of the algorithm's length, which SQLite does not have."""
    if op.get_bind().dialect.name == "postgresql":
        op.alter_column("runs", "algorithm", type_=sa.Text(), existing_type=sa.String(32), existing_nullable=False)
