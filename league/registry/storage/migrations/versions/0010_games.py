"""What decides the results of a league. Earlier results are identified by their environment alone."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    """Adds two columns."""
    op.add_column("leagues", sa.Column("game", sa.JSON(), nullable=True))
    op.add_column("leagues", sa.Column("game_digest", sa.String(length=64), nullable=True))
    op.execute("UPDATE leagues SET game = '{}', game_digest = environment_digest")
    with op.batch_alter_table("leagues") as leagues:
        leagues.alter_column("game", existing_type=sa.JSON(), nullable=False)
        leagues.alter_column("game_digest", existing_type=sa.String(length=64), nullable=False)
