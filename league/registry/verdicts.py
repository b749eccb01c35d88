"""Verdicts: opened before the first match that they count, closed once; after that, a person may void one, and nothing
else is ever changed.
"""

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import func, select, tuple_
from sqlalchemy.orm import Session

from league.errors import Conflict, InvalidInput, UnknownVerdict
from league.registry import leagues, rows, versions
from league.registry.database import insert
from league.registry.tables import AliasEvent, Verdict

VOID = "void"


def start(
    session: Session, league: str, candidate: int, champion: str, schedule: str, settings: dict[str, Any]
) -> rows.VerdictRow:
    """Open the verdict of a schedule, or find it. Raises UnknownVersion, or Conflict if it differs."""
    versions.require(session, league, candidate)
    asked = {"league": league, "candidate": candidate, "champion": champion, "settings": settings}
    insert(session, Verdict, [asked | {"id": schedule, "opened_at": datetime.now(UTC)}])
    verdict = session.get_one(Verdict, schedule)
    for name, value in asked.items():
        if getattr(verdict, name) != value:
            raise Conflict(f"verdict {schedule} was opened with {name} {getattr(verdict, name)!r}, not {value!r}")
    return _row(verdict)


def close(session: Session, verdict: str, outcome: str, evidence: dict[str, Any]) -> None:
    """Record how it came out; twice is once. Raises UnknownVerdict, or Conflict if it came out otherwise before."""
    row = session.get(Verdict, verdict, with_for_update=True)
    if row is None:
        raise UnknownVerdict(f"there is no verdict {verdict!r}")
    if row.outcome is not None:
        if row.outcome != outcome:
            raise Conflict(f"verdict {verdict} is {row.outcome!r} already, it cannot become {outcome!r}")
        return
    row.outcome, row.evidence, row.closed_at = outcome, evidence, datetime.now(UTC)


def void(session: Session, verdict: str, note: str) -> rows.VerdictRow:
    """End a verdict for a reason beside its games, or take back one that has fallen; twice is once.

    What it has shown stays in its evidence, and its alpha is spent. A promotion that it led to is not undone.
    Raises UnknownVerdict, or Conflict for one whose promotion is just being applied.
    """
    row = session.get(Verdict, verdict, with_for_update=True)
    if row is None:
        raise UnknownVerdict(f"there is no verdict {verdict!r}")
    if row.outcome is None:
        leagues.lock(session, row.league)
        if session.scalars(select(AliasEvent).filter_by(verdict=verdict)).first() is not None:
            raise Conflict(f"the promotion of verdict {verdict} is just being applied: void it when it is closed")
    if row.outcome != VOID:
        row.outcome, row.evidence = VOID, {**(row.evidence or {}), "note": note}
        row.closed_at = row.closed_at or datetime.now(UTC)
    return _row(row)


def require_open(session: Session, verdict: str) -> None:
    """Raise Conflict if it has been closed, such as by a person."""
    row = session.get(Verdict, verdict)
    if row is not None and row.outcome is not None:
        raise Conflict(f"verdict {verdict} is {row.outcome!r}: it promotes nobody")


def one(session: Session, verdict: str) -> rows.VerdictRow:
    """A verdict by its id. Raises UnknownVerdict."""
    row = session.get(Verdict, verdict)
    if row is None:
        raise UnknownVerdict(f"there is no verdict {verdict!r}")
    return _row(row)


def every(session: Session, league: str) -> list[rows.VerdictRow]:
    """All verdicts of a league, in the order in which they were opened. Raises UnknownLeague."""
    leagues.require(session, league)
    query = select(Verdict).filter_by(league=league).order_by(Verdict.opened_at, Verdict.id)
    return [_row(verdict) for verdict in session.scalars(query)]


def newest(session: Session, league: str, before: str | None, limit: int) -> list[rows.VerdictRow]:
    """Those of a league, newest first, at most `limit`, of those opened before `before`.

    Raises UnknownLeague, or InvalidInput if `before` is none of them.
    """
    leagues.require(session, league)
    query = select(Verdict).filter_by(league=league).order_by(Verdict.opened_at.desc(), Verdict.id.desc()).limit(limit)
    if before is not None:
        last = session.get(Verdict, before)
        if last is None or last.league != league:
            raise InvalidInput(f"before: league {league} has no verdict {before!r}")
        query = query.where(tuple_(Verdict.opened_at, Verdict.id) < (last.opened_at, last.id))
    return [_row(verdict) for verdict in session.scalars(query)]


def last_closed(session: Session) -> dict[str, rows.VerdictRow]:
    """league → the verdict that was closed last, of the leagues that have one."""
    closed = select(Verdict).where(Verdict.closed_at.is_not(None)).order_by(Verdict.closed_at, Verdict.id)
    latest = select(Verdict.league, func.max(Verdict.closed_at).label("at")).group_by(Verdict.league).subquery()
    of_latest = (Verdict.league == latest.c.league) & (Verdict.closed_at == latest.c.at)
    return {verdict.league: _row(verdict) for verdict in session.scalars(closed.join(latest, of_latest))}


def _row(verdict: Verdict) -> rows.VerdictRow:
    return rows.VerdictRow(
        id=verdict.id,
        league=verdict.league,
        candidate=verdict.candidate,
        champion=verdict.champion,
        settings=verdict.settings,
        outcome=verdict.outcome,
        evidence=verdict.evidence,
        opened_at=verdict.opened_at,
        closed_at=verdict.closed_at,
    )
