"""What decides the results of a league. Earlier results are identified by their environment alone."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    """Adds two columns."""
    # With defaults: SQLite would remove them by replacing the table, which fails while others refer to it.
    op.add_column("leagues", sa.Column("game", sa.JSON(), nullable=False, server_default="{}"))
    op.add_column("leagues", sa.Column("game_digest", sa.String(length=64), nullable=False, server_default=""))
    op.execute("UPDATE leagues SET game_digest = environment_digest")
