"""Strength of versions during training, targets of exploiters' runs, and the earlier games of leagues."""

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"


def upgrade() -> None:
    """Adds a column and two tables."""
    op.add_column("runs", sa.Column("exploits", sa.Text, nullable=True))
    op.create_table(
        "strengths",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("version", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("opponent", sa.String(length=512), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("steps", sa.BigInteger(), nullable=False),
        sa.Column("games", sa.Integer(), nullable=False),
        sa.Column("score", sa.Double(), nullable=False),
        sa.Column("low", sa.Double(), nullable=False),
        sa.Column("high", sa.Double(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["league", "version"], ["versions.league", "versions.number"], name=op.f("fk_strengths_league_version")
        ),
        sa.PrimaryKeyConstraint("league", "version", "opponent", name=op.f("pk_strengths")),
    )
    op.create_index("ix_strengths_league_run", "strengths", ["league", "run"], unique=False)
    op.create_table(
        "earlier_games",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("game", sa.JSON(), nullable=False),
        sa.Column("replaced_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_earlier_games_league")),
        sa.PrimaryKeyConstraint("league", "digest", name=op.f("pk_earlier_games")),
    )
