"""The tables of version 0.1.0."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Create each table after those that it refers to."""
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
        "change_counter",
        sa.Column("id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("aliases", sa.BigInteger(), server_default="0", nullable=False),
        sa.Column("traffic", sa.BigInteger(), server_default="0", nullable=False),
        sa.Column("keys", sa.BigInteger(), server_default="0", nullable=False),
        sa.Column("leagues", sa.BigInteger(), server_default="0", nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_change_counter")),
    )
    op.create_table(
        "leagues",
        sa.Column("slug", sa.String(length=255), nullable=False),
        sa.Column("config", sa.JSON(), nullable=False),
        sa.Column("interface", sa.JSON(), nullable=False),
        sa.Column("interface_digest", sa.String(length=64), nullable=False),
        sa.Column("environment_digest", sa.String(length=64), nullable=False),
        sa.Column("game", sa.JSON(), nullable=False),
        sa.Column("game_digest", sa.String(length=64), nullable=False),
        sa.Column("last_version", sa.Integer(), nullable=False),
        sa.Column("registered_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("archived_at", sa.DateTime(timezone=True), nullable=True),
        sa.PrimaryKeyConstraint("slug", name=op.f("pk_leagues")),
    )
    op.create_table(
        "replicas",
        sa.Column("replica", sa.String(length=255), nullable=False),
        sa.Column("process", sa.JSON(), nullable=False),
        sa.Column("changes", sa.BigInteger(), nullable=True),
        sa.Column("event", sa.Integer(), nullable=True),
        sa.Column("traffic", sa.Integer(), nullable=True),
        sa.Column("seen_at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("replica", name=op.f("pk_replicas")),
    )
    op.create_index(op.f("ix_replicas_seen_at"), "replicas", ["seen_at"], unique=False)
    op.create_table(
        "reports",
        sa.Column("replica", sa.String(length=255), nullable=False),
        sa.Column("document", sa.JSON(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.PrimaryKeyConstraint("replica", name=op.f("pk_reports")),
    )
    op.create_index(op.f("ix_reports_at"), "reports", ["at"], unique=False)
    op.create_table(
        "acknowledgements",
        sa.Column("replica", sa.String(length=255), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("version", sa.Integer(), nullable=True),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("fault", sa.Text(), nullable=True),
        sa.Column("aliases", sa.JSON(), nullable=False),
        sa.Column("traffic", sa.Integer(), nullable=True),
        sa.Column("event", sa.Integer(), nullable=True),
        sa.Column("seen_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_acknowledgements_league")),
        sa.PrimaryKeyConstraint("replica", "league", name=op.f("pk_acknowledgements")),
    )
    op.create_index(op.f("ix_acknowledgements_seen_at"), "acknowledgements", ["seen_at"], unique=False)
    op.create_table(
        "earlier_games",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("game", sa.JSON(), nullable=False),
        sa.Column("replaced_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_earlier_games_league")),
        sa.PrimaryKeyConstraint("league", "digest", name=op.f("pk_earlier_games")),
    )
    op.create_table(
        "evaluations",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("request", sa.JSON(), nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("progress", sa.JSON(), nullable=True),
        sa.Column("result", sa.JSON(), nullable=True),
        sa.Column("error", sa.JSON(), nullable=True),
        sa.Column("actor", sa.Text(), nullable=False),
        sa.Column("key", sa.String(length=8), nullable=True),
        sa.Column("reason", sa.Text(), nullable=True),
        sa.Column("workers", sa.Integer(), nullable=True),
        sa.Column("runner", sa.String(length=64), nullable=True),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("created_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("started_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("heartbeat_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("stop_at", sa.DateTime(timezone=True), nullable=True),
        sa.Column("stopped_by", sa.Text(), nullable=True),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["key"], ["api_keys.id"], name=op.f("fk_evaluations_key")),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_evaluations_league")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_evaluations")),
    )
    op.create_index("ix_evaluations_league_id", "evaluations", ["league", "id"], unique=False)
    op.create_index(op.f("ix_evaluations_state"), "evaluations", ["state"], unique=False)
    op.create_table(
        "nightly_runs",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("candidates", sa.JSON(), nullable=False),
        sa.Column("alpha", sa.Double(), nullable=False),
        sa.Column("report", sa.JSON(), nullable=True),
        sa.Column("began_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_nightly_runs_league")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_nightly_runs")),
    )
    op.create_index("ix_nightly_runs_league_id", "nightly_runs", ["league", "id"], unique=False)
    op.create_table(
        "runs",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("id", sa.String(length=64), nullable=False),
        sa.Column("algorithm", sa.String(length=32), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("seed", sa.BigInteger(), nullable=False),
        sa.Column("target", sa.BigInteger(), nullable=True),
        sa.Column("parent", sa.Integer(), nullable=True),
        sa.Column("exploits", sa.Text(), nullable=True),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("driver", sa.Text(), nullable=False),
        sa.Column("record", sa.JSON(), nullable=True),
        sa.Column("steps", sa.BigInteger(), nullable=False),
        sa.Column("seconds", sa.Double(), nullable=False),
        sa.Column("curves", sa.JSON(), nullable=False),
        sa.Column("spacing", sa.BigInteger(), nullable=False),
        sa.Column("began_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("heartbeat_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_runs_league")),
        sa.PrimaryKeyConstraint("league", "id", name=op.f("pk_runs")),
    )
    op.create_table(
        "schedules",
        sa.Column("sequence", sa.Integer(), nullable=False),
        sa.Column("id", sa.String(length=255), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("kind", sa.String(length=32), nullable=False),
        sa.Column("document", sa.Text(), nullable=False),
        sa.Column("opened_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("purged_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_schedules_league")),
        sa.PrimaryKeyConstraint("sequence", name=op.f("pk_schedules")),
        sa.UniqueConstraint("id", name=op.f("uq_schedules_id")),
    )
    op.create_index(op.f("ix_schedules_league"), "schedules", ["league"], unique=False)
    op.create_table(
        "snapshots",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("part", sa.String(length=300), nullable=False),
        sa.Column("mark", sa.Text(), nullable=False),
        sa.Column("document", sa.JSON(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_snapshots_league")),
        sa.PrimaryKeyConstraint("league", "part", name=op.f("pk_snapshots")),
    )
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
        "training_nights",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("parent", sa.Integer(), nullable=True),
        sa.Column("steps", sa.JSON(), nullable=False),
        sa.Column("began_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("ended_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(["league"], ["leagues.slug"], name=op.f("fk_training_nights_league")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_training_nights")),
    )
    op.create_index("ix_training_nights_league_id", "training_nights", ["league", "id"], unique=False)
    op.create_table(
        "versions",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("number", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("source", sa.Text(), nullable=False),
        sa.Column("parent", sa.Integer(), nullable=True),
        sa.Column("role", sa.String(length=16), nullable=False),
        sa.Column("exploits", sa.Text(), nullable=True),
        sa.Column("publisher", sa.Text(), nullable=False),
        sa.Column("reserved_at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("manifest", sa.Text(), nullable=True),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("retired_at", sa.DateTime(timezone=True), nullable=True),
        sa.ForeignKeyConstraint(
            ["league", "parent"], ["versions.league", "versions.number"], name=op.f("fk_versions_league_parent")
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
    op.create_table(
        "matches",
        sa.Column("schedule", sa.String(length=255), nullable=False),
        sa.Column("position", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("first", sa.Text(), nullable=False),
        sa.Column("second", sa.Text(), nullable=False),
        sa.Column("games", sa.Integer(), nullable=False),
        sa.Column("scores", sa.Text(), nullable=False),
        sa.Column("returns", sa.Text(), nullable=False),
        sa.Column("moves", sa.Text(), nullable=False),
        sa.Column("played_at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["schedule"], ["schedules.id"], name=op.f("fk_matches_schedule")),
        sa.PrimaryKeyConstraint("schedule", "position", name=op.f("pk_matches")),
    )
    op.create_index(
        "ix_matches_league_first_second_played_at", "matches", ["league", "first", "second", "played_at"], unique=False
    )
    op.create_index("ix_matches_league_played_at", "matches", ["league", "played_at"], unique=False)
    op.create_table(
        "run_points",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("steps", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("curves", sa.JSON(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league", "run"], ["runs.league", "runs.id"], name=op.f("fk_run_points_league_run")),
        sa.PrimaryKeyConstraint("league", "run", "steps", name=op.f("pk_run_points")),
    )
    op.create_table(
        "shadow_counts",
        sa.Column("replica", sa.String(length=255), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("candidate", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("champion", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("requests", sa.BigInteger(), nullable=False),
        sa.Column("observations", sa.BigInteger(), nullable=False),
        sa.Column("agreed", sa.BigInteger(), nullable=False),
        sa.Column("failed", sa.BigInteger(), nullable=False),
        sa.Column("dropped", sa.BigInteger(), nullable=False),
        sa.Column("skipped", sa.BigInteger(), nullable=False),
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
            ["league", "candidate"], ["versions.league", "versions.number"], name=op.f("fk_verdicts_league_candidate")
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_verdicts")),
    )
    op.create_index(op.f("ix_verdicts_league"), "verdicts", ["league"], unique=False)
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
    op.create_index("ix_version_notes_league_id", "version_notes", ["league", "id"], unique=False)
    op.create_index("ix_version_notes_league_version_id", "version_notes", ["league", "version", "id"], unique=False)
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
            ["league", "version"], ["versions.league", "versions.number"], name=op.f("fk_alias_events_league_version")
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
            ["league", "version"], ["versions.league", "versions.number"], name=op.f("fk_aliases_league_version")
        ),
        sa.PrimaryKeyConstraint("league", "name", name=op.f("pk_aliases")),
    )
    op.create_table(
        "idempotent_calls",
        sa.Column("owner", sa.String(length=8), nullable=False),
        sa.Column("key", sa.String(length=255), nullable=False),
        sa.Column("digest", sa.String(length=64), nullable=False),
        sa.Column("event", sa.Integer(), nullable=True),
        sa.Column("traffic", sa.Integer(), nullable=True),
        sa.Column("evaluation", sa.Integer(), nullable=True),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["evaluation"], ["evaluations.id"], name=op.f("fk_idempotent_calls_evaluation")),
        sa.ForeignKeyConstraint(["event"], ["alias_events.id"], name=op.f("fk_idempotent_calls_event")),
        sa.ForeignKeyConstraint(["owner"], ["api_keys.id"], name=op.f("fk_idempotent_calls_owner")),
        sa.ForeignKeyConstraint(["traffic"], ["traffic_events.id"], name=op.f("fk_idempotent_calls_traffic")),
        sa.PrimaryKeyConstraint("owner", "key", name=op.f("pk_idempotent_calls")),
    )
    op.create_index(op.f("ix_idempotent_calls_at"), "idempotent_calls", ["at"], unique=False)
