"""Canaries and shadows, shadow counters, and metrics of replicas."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Adds tables; the result of an idempotent call may be a traffic event."""
    op.create_table(
        "traffic_events",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("canary", sa.String(length=255), nullable=True),
        sa.Column("canary_share", sa.Double(), nullable=True),
        sa.Column("shadow", sa.String(length=255), nullable=True),
        sa.Column("shadow_share", sa.Double(), nullable=True),
        sa.Column("actor", sa.Text(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_traffic_events_league")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_traffic_events")),
    )
    op.create_index("ix_traffic_events_league_id", "traffic_events", ["league", "id"], unique=False)
    op.create_table(
        "shadow_counts",
        sa.Column("replica", sa.String(length=255), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("candidate", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("champion", sa.Integer(), autoincrement=False, nullable=False),
        *(
            sa.Column(name, sa.BigInteger(), nullable=False)
            for name in ("requests", "observations", "agreed", "failed", "dropped", "skipped")
        ),
        sa.Column("latency", sa.JSON(), nullable=False),
        sa.Column("ns", sa.BigInteger(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(
            ["league", "candidate"],
            ["versions.league", "versions.number"],
            name=op.f("fk_shadow_counts_league_candidate"),
        ),
        sa.ForeignKeyConstraint(
            ["league", "champion"],
            ["versions.league", "versions.number"],
            name=op.f("fk_shadow_counts_league_champion"),
        ),
        sa.PrimaryKeyConstraint("replica", "league", "candidate", "champion", name=op.f("pk_shadow_counts")),
    )
    op.create_index(op.f("ix_shadow_counts_at"), "shadow_counts", ["at"], unique=False)
    op.create_table(
        "reports",
        sa.Column("replica", sa.String(length=255), nullable=False),
        sa.Column("document", sa.JSON(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("replica", name=op.f("pk_reports")),
    )
    op.create_index(op.f("ix_reports_at"), "reports", ["at"], unique=False)
    with op.batch_alter_table("acknowledgements") as acknowledgements:
        acknowledgements.add_column(sa.Column("traffic", sa.Integer(), nullable=True))
    with op.batch_alter_table("idempotent_calls") as calls:
        calls.alter_column("event", existing_type=sa.Integer(), nullable=True)
        calls.add_column(sa.Column("traffic", sa.Integer(), nullable=True))
        calls.create_foreign_key(op.f("fk_idempotent_calls_traffic"), "traffic_events", ["traffic"], ["id"])
