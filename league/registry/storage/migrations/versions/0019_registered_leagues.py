"""Replicas follow how the versions of a league select actions, which a registration may change."""

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"


def upgrade() -> None:
    """Adds a column."""
    op.add_column("change_counter", sa.Column("leagues", sa.BigInteger, nullable=False, server_default="0"))
