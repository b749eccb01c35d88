"""Training runs as their drivers report them: settings, progress, learning curves and outcome.

    running → ended | failed | stopped → running, if it is resumed

A driver sends heartbeats; a run without a recent heartbeat is `silent`. The number of points of a run is bounded: when
there are too many, every second point is deleted, and the spacing of new points doubles.
"""

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session, undefer

from league.errors import InvalidReference, UnknownRun
from league.registry import leagues
from league.registry.processes import this_process
from league.registry.storage.database import Repository, as_method, reading, writing
from league.registry.storage.rows import HEARTBEAT_TIMEOUT, RunPoint, RunRow, RunState

RUNNING = "running"
MAX_STORED = 20
"""Newest runs that are searched for one to continue."""
MAX_LISTED = 5
"""Runs that a message about an unknown one lists."""
MAX_POINTS = 601
"""At this number, every second point is deleted. Odd, so that the first and the last point are kept."""


def _get(session: Session, league: str, run: str) -> RunRow:
    """Return one training run. Raises UnknownLeague or UnknownRun."""
    leagues.require(session, league)
    return session.get(RunRow, (league, run)) or _unknown(league, run)


class RunRepository(Repository):
    """Records and reads training runs."""

    @writing
    def begin(
        self,
        session: Session,
        league: str,
        run: str,
        *,
        algorithm: str,
        settings: dict[str, Any],
        seed: int,
        target: int | None,
        parent: int | None = None,
        exploits: str | None = None,
        steps: int = 0,
        record: dict[str, Any] | None = None,
    ) -> RunRow:
        """Record that a training run starts, or resumes at `steps`; later points are deleted.

        target: steps at which the run ends, None if only its time is limited. parent: the version that training
        starts from. exploits: the version that an exploiter is trained against. record: what another machine needs to
        continue the run, see `stored`. Raises UnknownLeague.
        """
        started_at = datetime.now(UTC)
        leagues.require(session, league)
        values: dict[str, Any] = {
            "algorithm": algorithm,
            "settings": settings,
            "seed": seed,
            "target": target,
            "parent": parent,
            "exploits": exploits,
            "reported_state": RUNNING,
            "error": None,
            "driver": this_process(),
            "record": record,
            "steps": steps,
            "heartbeat_at": started_at,
            "ended_at": None,
        }
        row = session.get(RunRow, (league, run), with_for_update=True)
        if row is None:
            first: dict[str, Any] = {
                "attempts": 0,
                "seconds": 0.0,
                "curves": {},
                "spacing": 0,
                "began_at": started_at,
            }
            row = RunRow(league=league, id=run, **first, **values)
            session.add(row)
        for name, value in values.items():
            setattr(row, name, value)
        row.attempts += 1
        session.flush()
        session.execute(delete(RunPoint).filter_by(league=league, run=run).where(RunPoint.steps > steps))
        return row

    @writing
    def record(
        self, session: Session, league: str, run: str, point: RunPoint | None, seconds: float | None = None
    ) -> None:
        """Record a heartbeat of a run's driver and the newest point of its curves, if any. Raises UnknownRun.

        seconds: training time so far.
        """
        row = _locked(session, league, run)
        row.heartbeat_at = datetime.now(UTC)
        if seconds is not None:
            row.seconds = seconds
        if point is not None:
            row.steps, row.curves = point.steps, {**row.curves, **point.curves}
            _keep(session, row, point)

    @writing
    def end(self, session: Session, league: str, run: str, state: RunState, error: str | None = None) -> None:
        """Record how a run ended. Raises UnknownRun."""
        row = _locked(session, league, run)
        row.reported_state, row.error = state, error
        row.heartbeat_at = row.ended_at = datetime.now(UTC)

    get = as_method(_get)

    @reading
    def find(self, session: Session, text: str) -> RunRow:
        """Return the run with this id, or the only one whose id begins with it; `LEAGUE/RUN` searches one league.

        Raises UnknownRun, or InvalidReference with the candidates if there are several.
        """
        league, _, run = text.rpartition("/")
        table = RunRow
        query = select(table).order_by(table.began_at.desc(), table.league, table.id)
        if league:
            query = query.filter_by(league=league)
        candidates = list(session.scalars(query.where(table.id.startswith(run, autoescape=True)))) if run else []
        exact = [row for row in candidates if row.id == run]
        if len(candidates := exact or candidates) == 1:
            return candidates[0]
        listed = ", ".join(f"{row.league}/{row.id}" for row in candidates or session.scalars(query.limit(MAX_LISTED)))
        if candidates:
            raise InvalidReference(f"training run {text!r} is ambiguous: {listed}")
        raise UnknownRun(f"there is no training run {text!r}; newest: {listed or 'none yet'}")

    @reading
    def newest(self, session: Session, league: str, *, before: str | None = None, limit: int = 20) -> list[RunRow]:
        """Return at most `limit` training runs of a league, newest first.

        before: return only runs that began before this one.
        Raises UnknownLeague, or InvalidInput if `before` is not a run of the league.
        """
        key = RunRow.began_at, RunRow.id
        return leagues.newest(session, league, RunRow, what="training run", key=key, before=before, limit=limit)

    @reading
    def stored(self, session: Session, league: str, run: str | None = None) -> list[RunRow]:
        """Return the newest runs of a league, or one of them, that can be continued on another machine, newest first.

        They have their `record`, which other methods do not read. Raises UnknownLeague.
        """
        table = RunRow
        query = select(table).filter_by(league=league).order_by(table.began_at.desc(), table.id.desc())
        if run is not None:
            query = query.filter_by(id=run)
        with_records = query.options(undefer(table.record)).where(table.record.is_not(None))
        return leagues.rows(session, league, with_records.limit(MAX_STORED))

    @reading
    def counts(self, session: Session) -> dict[str, int]:
        """Return league → number of active training runs, of the leagues that have any."""
        alive = (RunRow.reported_state == RUNNING) & (RunRow.heartbeat_at >= datetime.now(UTC) - HEARTBEAT_TIMEOUT)
        rows = session.execute(select(RunRow.league, func.count()).where(alive).group_by(RunRow.league))
        return dict(rows.tuples().all())

    @reading
    def points(self, session: Session, league: str, run: str) -> list[RunPoint]:
        """Return the points of a run's curves, sorted by steps, fewer than MAX_POINTS.

        Raises UnknownLeague or UnknownRun.
        """
        table = RunPoint
        query = select(table).filter_by(league=league, run=run).order_by(table.steps)
        _get(session, league, run)
        return list(session.scalars(query))


def active(session: Session, league: str) -> tuple[RunRow, ...]:
    """Return the runs of a league in state `running` or `silent`, oldest first."""
    query = select(RunRow).filter_by(league=league, reported_state=RUNNING).order_by(RunRow.began_at, RunRow.id)
    return tuple(session.scalars(query))


def is_trained(session: Session, league: str) -> bool:
    """Whether a run of the league sends heartbeats."""
    return any(run.state == RUNNING for run in active(session, league))


def _locked(session: Session, league: str, run: str) -> RunRow:
    return session.get(RunRow, (league, run), with_for_update=True) or _unknown(league, run)


def _unknown(league: str, run: str) -> RunRow:
    raise UnknownRun(f"league {league} has no training run {run!r}")


def _keep(session: Session, row: RunRow, point: RunPoint) -> None:
    """Store the newest point; delete the one before it unless that is far enough from its own predecessor."""
    table = RunPoint
    of_run = (table.league == row.league) & (table.run == row.id)
    session.execute(delete(table).where(of_run, table.steps >= point.steps))
    newest = session.scalars(select(table.steps).where(of_run).order_by(table.steps.desc()).limit(2)).all()
    if len(newest) == 2 and newest[0] - newest[1] < row.spacing:
        session.execute(delete(table).where(of_run, table.steps == newest[0]))
    session.add(replace(point))  # the driver's own is not of this transaction
    session.flush()
    kept = session.scalars(select(table.steps).where(of_run).order_by(table.steps)).all()
    if len(kept) >= MAX_POINTS:
        session.execute(delete(table).where(of_run, table.steps.in_(kept[1::2])))
        # Points are not equidistant: a spacing below the mean distance still keeps only every second point.
        row.spacing = (kept[-1] - kept[0]) * 3 // (4 * len(kept[2::2]))
