"""The first tables."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Create each table after those that it refers to."""
    _leagues_and_versions()
    _schedules_and_matches()
    _verdicts()
    _aliases()
    _acknowledgements()


def _leagues_and_versions() -> None:
    op.create_table(
        "leagues",
        sa.Column("slug", sa.String(length=255), nullable=False),
        sa.Column("config", sa.JSON(), nullable=False),
        sa.Column("interface", sa.JSON(), nullable=False),
        sa.Column("interface_digest", sa.String(length=64), nullable=False),
        sa.Column("environment_digest", sa.String(length=64), nullable=False),
        sa.Column("last_version", sa.Integer(), nullable=False),
        sa.Column("registered_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("slug", name=op.f("pk_leagues")),
    )
    op.create_table(
        "versions",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("source", sa.Text(), nullable=False),
        sa.Column("parent", sa.Integer(), nullable=True),
        sa.Column("publisher", sa.Text(), nullable=False),
        sa.Column("reserved_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("manifest", sa.Text(), nullable=True),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.ForeignKeyConstraint(
            ["league", "parent"],
            ["versions.league", "versions.number"],
            name=op.f("fk_versions_league_parent"),
        ),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_versions_league")),
        sa.PrimaryKeyConstraint("league", "number", name=op.f("pk_versions")),
    )
    op.create_index(
        "uq_versions_ready_source",
        "versions",
        ["league", "source"],
        unique=True,
        sqlite_where=sa.text("state = 'ready'"),
        postgresql_where=sa.text("state = 'ready'"),
    )


def _schedules_and_matches() -> None:
    op.create_table(
        "schedules",
        sa.Column("sequence", sa.Integer(), nullable=False),
        sa.Column("id", sa.String(length=255), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("document", sa.Text(), nullable=False),
        sa.Column("opened_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_schedules_league")),
        sa.PrimaryKeyConstraint("sequence", name=op.f("pk_schedules")),
        sa.UniqueConstraint("id", name=op.f("uq_schedules_id")),
    )
    op.create_index(op.f("ix_schedules_league"), "schedules", ["league"], unique=False)
    op.create_table(
        "matches",
        sa.Column("schedule", sa.String(length=255), nullable=False),
        sa.Column("position", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("games", sa.Integer(), nullable=False),
        sa.Column("scores", sa.Text(), nullable=False),
        sa.Column("returns", sa.Text(), nullable=False),
        sa.Column("moves", sa.Text(), nullable=False),
        sa.Column("played_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["schedule"], ["schedules.id"], name=op.f("fk_matches_schedule")),
        sa.PrimaryKeyConstraint("schedule", "position", name=op.f("pk_matches")),
    )


def _verdicts() -> None:
    op.create_table(
        "verdicts",
        sa.Column("id", sa.String(length=255), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("candidate", sa.Integer(), nullable=False),
        sa.Column("champion", sa.Text(), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("outcome", sa.String(length=16), nullable=True),
        sa.Column("evidence", sa.JSON(), nullable=True),
        sa.Column("opened_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("closed_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(
            ["league", "candidate"],
            ["versions.league", "versions.number"],
            name=op.f("fk_verdicts_league_candidate"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_verdicts")),
    )
    op.create_index(op.f("ix_verdicts_league"), "verdicts", ["league"], unique=False)


def _aliases() -> None:
    op.create_table(
        "alias_events",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("alias", sa.String(length=255), nullable=False),
        sa.Column("kind", sa.String(length=16), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("previous", sa.Integer(), nullable=True),
        sa.Column("beneath", sa.Integer(), nullable=True),
        sa.Column("actor", sa.Text(), nullable=False),
        sa.Column("reason", sa.Text(), nullable=False),
        sa.Column("verdict", sa.String(length=255), nullable=True),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["beneath"], ["alias_events.id"], name=op.f("fk_alias_events_beneath")),
        sa.ForeignKeyConstraint(
            ["league", "version"],
            ["versions.league", "versions.number"],
            name=op.f("fk_alias_events_league_version"),
        ),
        sa.ForeignKeyConstraint(["verdict"], ["verdicts.id"], name=op.f("fk_alias_events_verdict")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_alias_events")),
    )
    op.create_index("ix_alias_events_league_alias_id", "alias_events", ["league", "alias", "id"], unique=False)
    op.create_table(
        "aliases",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("name", sa.String(length=255), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("event", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["event"], ["alias_events.id"], name=op.f("fk_aliases_event")),
        sa.ForeignKeyConstraint(
            ["league", "version"],
            ["versions.league", "versions.number"],
            name=op.f("fk_aliases_league_version"),
        ),
        sa.PrimaryKeyConstraint("league", "name", name=op.f("pk_aliases")),
    )


def _acknowledgements() -> None:
    op.create_table(
        "acknowledgements",
        sa.Column("replica", sa.String(length=255), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("version", sa.Integer(), nullable=True),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("fault", sa.Text(), nullable=True),
        sa.Column("seen_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_acknowledgements_league")),
        sa.PrimaryKeyConstraint("replica", "league", name=op.f("pk_acknowledgements")),
    )
    op.create_index(op.f("ix_acknowledgements_seen_at"), "acknowledgements", ["seen_at"], unique=False)
