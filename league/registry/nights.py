"""Nights: opened with their candidates before the first verdict, so that one which was killed goes on with the same."""

from collections.abc import Collection
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from league.registry import leagues, rows
from league.registry.tables import Night


def start(session: Session, league: str, candidates: Collection[int], alpha: float) -> rows.NightRow:
    """Open a night, or find the one that is open, whatever it was opened with. Raises UnknownLeague."""
    leagues.lock(session, league)
    if (night := session.scalars(select(Night).filter_by(league=league, ended_at=None)).first()) is None:
        night = Night(league=league, candidates=sorted(candidates), alpha=alpha, began_at=datetime.now(UTC))
        session.add(night)
        session.flush()
    return _row(night)


def close(session: Session, night: int, report: dict[str, Any] | None) -> None:
    """End it and record what came of it; twice is once."""
    row = session.get_one(Night, night)
    if row.ended_at is None:
        row.report, row.ended_at = report, datetime.now(UTC)


def every(session: Session, league: str) -> list[rows.NightRow]:
    """All nights of a league, oldest first. Raises UnknownLeague."""
    leagues.require(session, league)
    return [_row(night) for night in session.scalars(select(Night).filter_by(league=league).order_by(Night.id))]


def _row(night: Night) -> rows.NightRow:
    return rows.NightRow(
        id=night.id,
        league=night.league,
        candidates=tuple(night.candidates),
        alpha=night.alpha,
        report=night.report,
        began_at=night.began_at,
        ended_at=night.ended_at,
    )
