"""The gateways to which simulators connect."""

import sqlalchemy as sa
from alembic import op

from league.registry.storage.tables import Utc

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Create the table."""
    op.create_table(
        "gateways",
        sa.Column("url", sa.String(length=255), nullable=False),
        sa.Column("token", sa.String(length=255), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("purpose", sa.String(length=32), nullable=False),
        sa.Column("simulators", sa.Integer(), nullable=False),
        sa.Column("waiting", sa.Integer(), nullable=False),
        sa.Column("seen_at", Utc(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_gateways_league")),
        sa.PrimaryKeyConstraint("url", "token", name=op.f("pk_gateways")),
    )
    op.create_index(op.f("ix_gateways_league"), "gateways", ["league"], unique=False)
