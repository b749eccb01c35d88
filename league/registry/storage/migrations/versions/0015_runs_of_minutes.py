"""Training runs that only their time limits."""

import sqlalchemy as sa
from alembic import op

revision = "0015"
down_revision = "0014"


def upgrade() -> None:
    """Makes a column nullable, by replacing it: SQLite would otherwise replace the table, which others refer to."""
    op.add_column("runs", sa.Column("max_steps", sa.BigInteger(), nullable=True))
    op.execute("UPDATE runs SET max_steps = target")
    op.execute("ALTER TABLE runs DROP COLUMN target")
    op.execute("ALTER TABLE runs RENAME COLUMN max_steps TO target")
