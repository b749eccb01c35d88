"""Snapshots, training runs, and indexes of matches by league and contestants."""

import json
from collections.abc import Iterable, Iterator
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Adds tables and columns, and fills the columns from the schedules."""
    _snapshots()
    _runs()
    # SQLite adds a column that is never null only with a default, unless it copies the table.
    op.add_column("schedules", sa.Column("kind", sa.String(length=32), server_default="", nullable=False))
    for name, kind in (("league", sa.String(length=255)), ("first", sa.Text()), ("second", sa.Text())):
        op.add_column("matches", sa.Column(name, kind, server_default="", nullable=False))
    _fill()
    op.create_index("ix_matches_league_played_at", "matches", ["league", "played_at"], unique=False)
    op.create_index(
        "ix_matches_league_first_second_played_at", "matches", ["league", "first", "second", "played_at"], unique=False
    )


def _snapshots() -> None:
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


def _runs() -> None:
    op.create_table(
        "runs",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("id", sa.String(length=64), nullable=False),
        sa.Column("algorithm", sa.String(length=32), nullable=False),
        sa.Column("settings", sa.JSON(), nullable=False),
        sa.Column("seed", sa.BigInteger(), nullable=False),
        sa.Column("target", sa.BigInteger(), nullable=False),
        sa.Column("parent", sa.Integer(), nullable=True),
        sa.Column("state", sa.String(length=16), nullable=False),
        sa.Column("error", sa.Text(), nullable=True),
        sa.Column("lives", sa.Integer(), nullable=False),
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
        "run_points",
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("run", sa.String(length=64), nullable=False),
        sa.Column("steps", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("curves", sa.JSON(), nullable=False),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.ForeignKeyConstraint(["league", "run"], ["runs.league", "runs.id"], name=op.f("fk_run_points_league_run")),
        sa.PrimaryKeyConstraint("league", "run", "steps", name=op.f("pk_run_points")),
    )


def _fill() -> None:
    connection = op.get_bind()
    schedules = sa.table("schedules", *map(sa.column, ("id", "document", "kind")))
    matches = sa.table("matches", *map(sa.column, ("schedule", "position", "league", "first", "second")))
    opened = connection.execute(sa.select(schedules.c.id, schedules.c.document)).all()
    for name, document in opened:
        schedule = json.loads(document)
        of_schedule = schedules.c.id == name
        connection.execute(sa.update(schedules).where(of_schedule).values(kind=schedule["kind"]))
        positions = connection.scalars(sa.select(matches.c.position).where(matches.c.schedule == name)).all()
        if not positions:
            continue
        of_position = (matches.c.schedule == name) & (matches.c.position == sa.bindparam("at"))
        values: dict[str, Any] = {column: sa.bindparam(f"new_{column}") for column in ("league", "first", "second")}
        rows = list(_contestants(schedule, positions))
        connection.execute(sa.update(matches).where(of_position).values(**values), rows)


def _contestants(schedule: dict[str, Any], positions: Iterable[int]) -> Iterator[dict[str, Any]]:
    pairings, contestants = schedule["pairings"], schedule["contestants"]
    for position in positions:
        first, second = (contestants[index] for index in pairings[position % len(pairings)])
        yield {"at": position, "new_league": schedule["league"], "new_first": first, "new_second": second}
