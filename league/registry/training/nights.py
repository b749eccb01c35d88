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
from league.registry.storage.database import Repository, reading, writing
from league.registry.storage.manifest import MAIN
from league.registry.storage.rows import TrainingNightRow
from league.registry.storage.tables import READY, AliasTable, VersionTable


class TrainingNightRepository(Repository):
    """Opens, records, closes and reads nights of training."""

    @writing
    def open(self, session: Session, league: str) -> TrainingNightRow:
        """Open a night, or return the one that is open. Raises UnknownLeague.

        Its training continues from the champion, or else from the newest version with the role `main`.
        """
        leagues.lock(session, league)
        night = session.scalars(select(TrainingNightRow).filter_by(league=league, ended_at=None)).first()
        if night is None:
            champion = select(AliasTable.version).filter_by(league=league, name=CHAMPION)
            table = VersionTable
            newest = select(table.number).filter_by(league=league, state=READY, role=MAIN, retired_at=None)
            earlier = session.scalar(select(func.count()).select_from(TrainingNightRow).filter_by(league=league))
            night = TrainingNightRow(
                number=(earlier or 0) + 1,
                league=league,
                parent=session.scalar(champion) or session.scalar(newest.order_by(table.number.desc()).limit(1)),
                steps={},
                began_at=datetime.now(UTC),
            )
            session.add(night)
            session.flush()
        return night

    @writing
    def record(self, session: Session, night: int, step: str, result: dict[str, Any]) -> TrainingNightRow:
        """Record the result of a step. A step that is recorded keeps its first result."""
        row = session.get_one(TrainingNightRow, night, with_for_update=True)
        row.steps = row.steps | {step: row.steps.get(step, result)}
        return row

    @writing
    def close(self, session: Session, night: int) -> TrainingNightRow:
        """End a night. Idempotent."""
        row = session.get_one(TrainingNightRow, night, with_for_update=True)
        row.ended_at = row.ended_at or datetime.now(UTC)
        return row

    @reading
    def all(self, session: Session, league: str) -> list[TrainingNightRow]:
        """Return all nights of a league, oldest first. Raises UnknownLeague."""
        query = select(TrainingNightRow).filter_by(league=league).order_by(TrainingNightRow.id)
        return leagues.rows(session, league, query)
