"""Nights of training: the steps of `league nightly --train` and their results.

The result of a step is recorded when the step is complete, so that an interrupted night continues with the step that
was interrupted.
"""

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from league.refs import CHAMPION
from league.registry import leagues
from league.registry.storage.database import Repository, repeat_after_deadlock
from league.registry.storage.manifest import MAIN
from league.registry.storage.rows import TrainingNightRow, detached
from league.registry.storage.tables import READY, AliasTable, TrainingNightTable, VersionTable


class TrainingNightRepository(Repository):
    """Opens, records, closes and reads nights of training."""

    @repeat_after_deadlock
    def open(self, league: str) -> TrainingNightRow:
        """Open a night, or return the one that is open. Raises UnknownLeague.

        Its training continues from the champion, or else from the newest version with the role `main`.
        """
        with self._database.write() as session:
            leagues.lock(session, league)
            night = session.scalars(select(TrainingNightTable).filter_by(league=league, ended_at=None)).first()
            if night is None:
                parent = _champion(session, league) or _newest(session, league)
                night = TrainingNightTable(league=league, parent=parent, steps={}, began_at=datetime.now(UTC))
                session.add(night)
                session.flush()
            return _row(session, night)

    @repeat_after_deadlock
    def record(self, night: int, step: str, result: dict[str, Any]) -> TrainingNightRow:
        """Record the result of a step. A step that is recorded keeps its first result."""
        with self._database.write() as session:
            row = session.get_one(TrainingNightTable, night, with_for_update=True)
            row.steps = row.steps | {step: row.steps.get(step, result)}
            return _row(session, row)

    @repeat_after_deadlock
    def close(self, night: int) -> TrainingNightRow:
        """End a night. Idempotent."""
        with self._database.write() as session:
            row = session.get_one(TrainingNightTable, night, with_for_update=True)
            row.ended_at = row.ended_at or datetime.now(UTC)
            return _row(session, row)

    def all(self, league: str) -> list[TrainingNightRow]:
        """Return all nights of a league, oldest first. Raises UnknownLeague."""
        query = select(TrainingNightTable).filter_by(league=league).order_by(TrainingNightTable.id)
        with self._database.read() as session:
            leagues.require(session, league)
            nights = enumerate(session.scalars(query), 1)
            return [detached(TrainingNightRow, night, number=number) for number, night in nights]


def _row(session: Session, night: TrainingNightTable) -> TrainingNightRow:
    table = TrainingNightTable
    until = select(func.count()).select_from(table).where(table.league == night.league, table.id <= night.id)
    return detached(TrainingNightRow, night, number=session.scalars(until).one())


def _champion(session: Session, league: str) -> int | None:
    return session.scalar(select(AliasTable.version).filter_by(league=league, name=CHAMPION))


def _newest(session: Session, league: str) -> int | None:
    table = VersionTable
    query = select(table.number).filter_by(league=league, state=READY, role=MAIN, retired_at=None)
    return session.scalar(query.order_by(table.number.desc()).limit(1))
