"""Notes on versions."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    """Adds a table."""
    op.create_table(
        "version_notes",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("text", sa.Text(), nullable=False),
        sa.Column("actor", sa.Text(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["league", "version"], ["versions.league", "versions.number"], name=op.f("fk_version_notes_league_version")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_version_notes")),
    )
    op.create_index("ix_version_notes_league_version_id", "version_notes", ["league", "version", "id"], unique=False)
    op.create_index("ix_version_notes_league_id", "version_notes", ["league", "id"], unique=False)
