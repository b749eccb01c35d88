"""Roles of versions: main or exploiter."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    """Adds two columns. Existing versions have the role `main`."""
    op.add_column("versions", sa.Column("role", sa.String(16), nullable=False, server_default="main"))
    op.add_column("versions", sa.Column("exploits", sa.Text, nullable=True))
