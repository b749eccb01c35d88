"""What another machine needs to continue a training run, and the process that trains it."""

import sqlalchemy as sa
from alembic import op

revision = "0018"
down_revision = "0017"


def upgrade() -> None:
    """Adds two columns."""
    op.add_column("runs", sa.Column("driver", sa.Text, nullable=True))
    op.add_column("runs", sa.Column("record", sa.JSON, nullable=True))
