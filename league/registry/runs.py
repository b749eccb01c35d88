"""Training runs, as their drivers tell of them: what is trained, how far it is, its curves, and how it ended.

    running → ended | failed | stopped → running, where it is gone on with

A driver says again and again that it lives; of one that fell silent nobody knows. A run keeps a bounded number of
points, however long it takes: when there are too many, every second one goes, and from then on they come half as often.
"""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import delete, func, select, tuple_
from sqlalchemy.orm import Session

from league.errors import InvalidInput, UnknownRun
from league.registry import leagues, rows
from league.registry.tables import Run, RunPoint

RUNNING = "running"
SILENT = timedelta(minutes=1)
"""A run of which nothing was heard for longer is said to be silent."""
FULL = 601
"""So many points are too many. Odd, so that the first and the last stay when every second one goes."""


def begin(
    session: Session,
    league: str,
    run: str,
    *,
    algorithm: str,
    settings: dict[str, Any],
    seed: int,
    target: int,
    parent: int | None,
    steps: int,
) -> rows.RunRow:
    """Record that a run begins, or goes on at `steps`: what it told beyond those is forgotten. Raises UnknownLeague."""
    leagues.require(session, league)
    now = datetime.now(UTC)
    row = session.get(Run, (league, run), with_for_update=True)
    if row is None:
        row = Run(league=league, id=run, lives=0, seconds=0.0, curves={}, spacing=0, began_at=now)
        session.add(row)
    row.algorithm, row.settings, row.seed, row.target, row.parent = algorithm, settings, seed, target, parent
    row.state, row.error, row.ended_at = RUNNING, None, None
    row.lives += 1
    row.steps, row.heartbeat_at = steps, now
    session.flush()
    session.execute(delete(RunPoint).filter_by(league=league, run=run).where(RunPoint.steps > steps))
    return _row(row)


def tell(
    session: Session, league: str, run: str, point: rows.RunPoint | None = None, seconds: float | None = None
) -> None:
    """Say that a run's driver lives, and where its curves are by now."""
    row = _held(session, league, run)
    row.heartbeat_at = datetime.now(UTC)
    if seconds is not None:
        row.seconds = seconds
    if point is not None:
        row.steps, row.curves = point.steps, {**row.curves, **point.curves}
        _keep(session, row, point)


def end(session: Session, league: str, run: str, state: rows.RunState, error: str | None) -> None:
    """Record how it ended."""
    row = _held(session, league, run)
    row.state, row.error = state, error
    row.heartbeat_at = row.ended_at = datetime.now(UTC)


def one(session: Session, league: str, run: str) -> rows.RunRow:
    """One of a league. Raises UnknownLeague or UnknownRun."""
    leagues.require(session, league)
    row = session.get(Run, (league, run))
    if row is None:
        raise UnknownRun(f"league {league} has no training run {run!r}")
    return _row(row)


def newest(session: Session, league: str, before: str | None, limit: int) -> list[rows.RunRow]:
    """Those of a league, newest first, that began before the run `before`. Raises UnknownLeague or InvalidInput."""
    leagues.require(session, league)
    query = select(Run).filter_by(league=league).order_by(Run.began_at.desc(), Run.id.desc()).limit(limit)
    if before is not None:
        last = session.get(Run, (league, before))
        if last is None:
            raise InvalidInput(f"before: league {league} has no training run {before!r}")
        query = query.where(tuple_(Run.began_at, Run.id) < (last.began_at, last.id))
    return [_row(row) for row in session.scalars(query)]


def active(session: Session, league: str) -> tuple[rows.RunRow, ...]:
    """Those of a league that nobody has ended, oldest first."""
    query = select(Run).filter_by(league=league, state=RUNNING).order_by(Run.began_at, Run.id)
    return tuple(_row(row) for row in session.scalars(query))


def counts(session: Session) -> dict[str, int]:
    """league → runs that are on, of the leagues that have any."""
    alive = (Run.state == RUNNING) & (Run.heartbeat_at >= datetime.now(UTC) - SILENT)
    found = session.execute(select(Run.league, func.count()).where(alive).group_by(Run.league))
    return dict(found.tuples().all())


def points(session: Session, league: str, run: str) -> list[rows.RunPoint]:
    """Those of a run, by their steps, the newest that is known among them. Raises UnknownLeague or UnknownRun."""
    one(session, league, run)
    query = select(RunPoint.steps, RunPoint.curves, RunPoint.at).filter_by(league=league, run=run)
    return [rows.RunPoint(*each) for each in session.execute(query.order_by(RunPoint.steps)).tuples()]


def _keep(session: Session, row: Run, point: rows.RunPoint) -> None:
    """The newest point is always kept; the one before it only if it is far enough from its own predecessor."""
    of_run = (RunPoint.league == row.league) & (RunPoint.run == row.id)
    session.execute(delete(RunPoint).where(of_run, RunPoint.steps >= point.steps))
    newest = session.scalars(select(RunPoint.steps).where(of_run).order_by(RunPoint.steps.desc()).limit(2)).all()
    if len(newest) == 2 and newest[0] - newest[1] < row.spacing:
        session.execute(delete(RunPoint).where(of_run, RunPoint.steps == newest[0]))
    session.add(RunPoint(league=row.league, run=row.id, steps=point.steps, curves=point.curves, at=point.at))
    session.flush()
    kept = session.scalars(select(RunPoint.steps).where(of_run).order_by(RunPoint.steps)).all()
    if len(kept) >= FULL:
        session.execute(delete(RunPoint).where(of_run, RunPoint.steps.in_(kept[1::2])))
        # Reports do not come at equal distances: with less than the mean one, still only every second one is kept.
        row.spacing = (kept[-1] - kept[0]) * 3 // (4 * len(kept[2::2]))


def _held(session: Session, league: str, run: str) -> Run:
    row = session.get(Run, (league, run), with_for_update=True)
    if row is None:
        raise UnknownRun(f"league {league} has no training run {run!r}")
    return row


def _row(run: Run) -> rows.RunRow:
    row = rows.RunRow(**{name: getattr(run, name) for name in rows.RunRow.__slots__})
    is_silent = row.state == RUNNING and row.heartbeat_at < datetime.now(UTC) - SILENT
    return replace(row, state="silent") if is_silent else row
