"""API keys, idempotent calls, and the version that each replica serves per alias."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Deletes the acknowledgements; replicas write them again within seconds."""
    op.create_table(
        "api_keys",
        sa.Column("id", sa.String(length=8), nullable=False),
        sa.Column("name", sa.String(length=255), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("scopes", sa.JSON(), nullable=False),
        sa.Column("leagues", sa.JSON(), nullable=True),
        sa.Column("rate", sa.Double(), nullable=True),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("revoked_at", sa.DateTime(timezone=True), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_api_keys")),
        sa.UniqueConstraint("name", name=op.f("uq_api_keys_name")),
        sa.UniqueConstraint("sha256", name=op.f("uq_api_keys_sha256")),
    )
    op.create_table(
        "idempotent_calls",
        sa.Column("owner", sa.String(length=8), nullable=False),
        sa.Column("key", sa.String(length=255), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("event", sa.Integer(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["event"], ["alias_events.id"], name=op.f("fk_idempotent_calls_event")),
        sa.ForeignKeyConstraint(["owner"], ["api_keys.id"], name=op.f("fk_idempotent_calls_owner")),
        sa.PrimaryKeyConstraint("owner", "key", name=op.f("pk_idempotent_calls")),
    )
    op.create_index(op.f("ix_idempotent_calls_at"), "idempotent_calls", ["at"], unique=False)
    op.execute("DELETE FROM acknowledgements")
    with op.batch_alter_table("acknowledgements") as acknowledgements:
        acknowledgements.add_column(sa.Column("aliases", sa.JSON(), nullable=False))
