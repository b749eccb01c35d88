"""Nights of training."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0011"


def upgrade() -> None:
    """Adds a table."""
    op.create_table(
        "training_nights",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("parent", sa.Integer(), nullable=True),
        sa.Column("steps", sa.JSON(), nullable=False),
        sa.Column("began_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_training_nights_league")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_training_nights")),
    )
    op.create_index("ix_training_nights_league_id", "training_nights", ["league", "id"], unique=False)
