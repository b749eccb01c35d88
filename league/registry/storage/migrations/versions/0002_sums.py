"""Sums over the matches of each schedule and pair of contestants."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Create the tables and fill them from the ledger."""
    totals = op.create_table(
        "schedule_totals",
        sa.Column("schedule", sa.String(length=255), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("matches", sa.BigInteger(), nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["schedule"], ["schedules.id"], name=op.f("fk_schedule_totals_schedule")),
        sa.PrimaryKeyConstraint("schedule", name=op.f("pk_schedule_totals")),
    )
    op.create_index("ix_schedule_totals_league_matches", "schedule_totals", ["league", "matches"], unique=False)
    pairs = op.create_table(
        "pair_sums",
        sa.Column("schedule", sa.String(length=255), nullable=False),
        sa.Column("first", sa.Text(), nullable=False),
        sa.Column("second", sa.Text(), nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("sums", sa.Text(), nullable=False),
        sa.Column("examples", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["schedule"], ["schedules.id"], name=op.f("fk_pair_sums_schedule")),
        sa.PrimaryKeyConstraint("schedule", "first", "second", name=op.f("pk_pair_sums")),
    )
    op.create_index(op.f("ix_pair_sums_league"), "pair_sums", ["league"], unique=False)
    digests = op.create_table(
        "game_digests",
        sa.Column("schedule", sa.String(length=255), nullable=False),
        sa.Column("stripe", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("league", sa.String(length=255), nullable=False),
        sa.Column("digests", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["schedule"], ["schedules.id"], name=op.f("fk_game_digests_schedule")),
        sa.PrimaryKeyConstraint("schedule", "stripe", name=op.f("pk_game_digests")),
    )
    op.create_index(op.f("ix_game_digests_league"), "game_digests", ["league"], unique=False)
    _fill(totals, pairs, digests)


def _fill(totals: sa.Table, pairs: sa.Table, digests: sa.Table) -> None:
    from league.results.records import load_games, load_schedule
    from league.results.schedule_sums import ScheduleSums

    connection = op.get_bind()
    matches = sa.table("matches", *(sa.column(name) for name in ("schedule", "position", "moves")))
    recorded = sa.select(matches.c.position, matches.c.moves).order_by(matches.c.position)
    for document in connection.execute(sa.text("SELECT document FROM schedules")).scalars().all():
        schedule = load_schedule(document)
        sums, last = ScheduleSums(schedule), -1
        while rows := connection.execute(
            recorded.where(matches.c.schedule == schedule.id, matches.c.position > last).limit(1000)
        ).all():
            sums.add([schedule.match(row.position, load_games(row.moves), 0) for row in rows])
            sums.size += sum(len(row.moves) for row in rows)
            last = rows[-1].position
        connection.execute(totals.insert(), [sums.total()])
        for table, table_rows in ((pairs, sums.pair_rows()), (digests, sums.digest_rows())):
            if table_rows:
                connection.execute(table.insert(), table_rows)
