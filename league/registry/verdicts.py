"""Verdicts and the nightly runs that open them.

A verdict is opened before the first match that it counts, and closed once. After that it can only be voided by a
person. A nightly run stores its candidates before the first verdict, so that an interrupted run resumes with the same.
"""

from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from league.errors import Conflict, InvalidReference, UnknownVerdict
from league.refs import SHORT_VERDICT, VERDICT, verdict_digest
from league.registry import leagues, versions
from league.registry.storage.database import Repository, insert, reading, writing
from league.registry.storage.rows import AliasEvent, NightlyRunRow, VerdictRow

VOID = "void"
MAX_LISTED = 5
"""Verdicts in a message about an ambiguous id."""


class VerdictRepository(Repository):
    """Opens, closes, voids and reads verdicts."""

    @writing
    def open(
        self, session: Session, league: str, candidate: int, champion: str, schedule: str, settings: dict[str, Any]
    ) -> VerdictRow:
        """Open the verdict that counts the matches of `schedule`, or return it if it exists. Its id is the schedule's.

        Raises UnknownVersion, or Conflict if it exists with other arguments.
        """
        values = {"league": league, "candidate": candidate, "champion": champion, "settings": settings}
        versions.require(session, league, candidate)
        insert(session, VerdictRow, [values | {"id": schedule, "opened_at": datetime.now(UTC)}])
        verdict = session.get_one(VerdictRow, schedule)
        for name, value in values.items():
            if (stored_value := getattr(verdict, name)) != value:
                raise Conflict(f"verdict {schedule} was opened with {name} {stored_value!r}, not {value!r}")
        return verdict

    @writing
    def settle(self, session: Session, verdict: str, test: dict[str, Any]) -> VerdictRow:
        """Record the schedule of a test whose opponents are trained now, and return the verdict.

        A closed verdict, and a test that has a schedule, stay as they are. Raises UnknownVerdict.
        test: its record, in place of that of the same kind.
        """
        row = _locked(session, verdict)
        if row.outcome is None:
            tests = [
                test if (record["kind"], record["schedule"]) == (test["kind"], None) else record
                for record in row.settings["tests"]
            ]
            row.settings = row.settings | {"tests": tests}
        return row

    @writing
    def close(self, session: Session, verdict: str, outcome: str, evidence: dict[str, Any]) -> None:
        """Record the outcome of a verdict. Idempotent. Raises UnknownVerdict, or Conflict if it has another outcome."""
        row = _locked(session, verdict)
        if row.outcome is None:
            row.outcome, row.evidence, row.closed_at = outcome, evidence, datetime.now(UTC)
        elif row.outcome != outcome:
            raise Conflict(f"verdict {verdict} is already {row.outcome!r}, it cannot become {outcome!r}")

    @writing
    def void(self, session: Session, verdict: str, note: str) -> VerdictRow:
        """Void a verdict, open or closed. Idempotent.

        Its evidence is kept and its alpha stays spent. A promotion that it led to is not undone.
        Raises UnknownVerdict, or Conflict while its promotion is being applied.
        """
        row = _locked(session, verdict)
        if row.outcome is None:
            leagues.lock(session, row.league)
            if session.scalars(select(AliasEvent).filter_by(verdict=verdict)).first() is not None:
                raise Conflict(f"the promotion of verdict {verdict} is being applied: void it once it is closed")
        if row.outcome != VOID:
            row.outcome, row.evidence = VOID, {**(row.evidence or {}), "note": note}
            row.closed_at = row.closed_at or datetime.now(UTC)
        return row

    @reading
    def get(self, session: Session, verdict: str) -> VerdictRow:
        """Return one verdict. Raises UnknownVerdict."""
        return session.get(VerdictRow, verdict) or _unknown(verdict)

    @reading
    def find(self, session: Session, text: str, league: str | None = None) -> VerdictRow:
        """Return the verdict with this id, or the only one whose id or digest begins with it.

        league: search the verdicts of this league only.

        Raises UnknownLeague, UnknownVerdict, or InvalidReference with the candidates if there are several.
        """
        table = VerdictRow
        begins = table.id.startswith(text, autoescape=True) | table.id.contains(VERDICT + text, autoescape=True)
        if league is not None:
            leagues.require(session, league)
        if (exact := session.get(table, text)) is not None and league in (None, exact.league):
            return exact
        rows = list(session.scalars(select(table).where(begins).order_by(table.id)))
        verdicts = [
            row
            for row in rows
            if league in (None, row.league) and (row.id.startswith(text) or verdict_digest(row.id).startswith(text))
        ]
        if not text or not verdicts:
            _unknown(text)
        if len(verdicts) > 1:
            raise InvalidReference(f"verdict {text!r} is ambiguous: {_candidates(verdicts)}")
        return verdicts[0]

    @reading
    def all(self, session: Session, league: str) -> list[VerdictRow]:
        """Return all verdicts of a league in the order in which they were opened. Raises UnknownLeague."""
        query = select(VerdictRow).filter_by(league=league).order_by(VerdictRow.opened_at, VerdictRow.id)
        return leagues.rows(session, league, query)

    @reading
    def newest(self, session: Session, league: str, *, before: str | None = None, limit: int = 20) -> list[VerdictRow]:
        """Return at most `limit` verdicts of a league, newest first.

        before: return only verdicts opened before this one.
        Raises UnknownLeague, or InvalidInput if `before` is not a verdict of the league.
        """
        key = VerdictRow.opened_at, VerdictRow.id
        return leagues.newest(session, league, VerdictRow, what="verdict", key=key, before=before, limit=limit)

    @reading
    def last_closed(self, session: Session) -> dict[str, VerdictRow]:
        """Return league → the verdict that was closed last, of the leagues that have one."""
        table = VerdictRow
        closed = select(table).where(table.closed_at.is_not(None)).order_by(table.closed_at, table.id)
        latest = select(table.league, func.max(table.closed_at).label("at")).group_by(table.league).subquery()
        is_latest = (table.league == latest.c.league) & (table.closed_at == latest.c.at)
        return {verdict.league: verdict for verdict in session.scalars(closed.join(latest, is_latest))}


class NightlyRunRepository(Repository):
    """Opens, closes and reads nightly runs."""

    @writing
    def open(self, session: Session, league: str, candidates: Collection[int], alpha: float) -> NightlyRunRow:
        """Open a nightly run that judges `candidates`, or return the one that is open. Raises UnknownLeague."""
        leagues.lock(session, league)
        run = session.scalars(select(NightlyRunRow).filter_by(league=league, ended_at=None)).first()
        if run is None:
            began_at = datetime.now(UTC)
            run = NightlyRunRow(league=league, candidates=tuple(sorted(candidates)), alpha=alpha, began_at=began_at)
            session.add(run)
            session.flush()
        return run

    @writing
    def close(self, session: Session, run: int, report: dict[str, Any] | None) -> None:
        """End a nightly run and store its report. Idempotent."""
        row = session.get_one(NightlyRunRow, run)
        if row.ended_at is None:
            row.report, row.ended_at = report, datetime.now(UTC)

    @reading
    def last_ended(self, session: Session) -> dict[str, datetime]:
        """Return league → when its last nightly run ended, of the leagues that have had one."""
        table = NightlyRunRow
        query = select(table.league, func.max(table.ended_at)).where(table.ended_at.is_not(None))
        rows = session.execute(query.group_by(table.league)).tuples()
        return {league: ended_at for league, ended_at in rows if ended_at is not None}

    @reading
    def all(self, session: Session, league: str) -> list[NightlyRunRow]:
        """Return all nightly runs of a league, oldest first. Raises UnknownLeague."""
        query = select(NightlyRunRow).filter_by(league=league).order_by(NightlyRunRow.id)
        return leagues.rows(session, league, query)


def require_open(session: Session, verdict: str) -> None:
    """Raise Conflict if a verdict has been closed."""
    row = session.get(VerdictRow, verdict)
    if row is not None and row.outcome is not None:
        raise Conflict(f"verdict {verdict} is {row.outcome!r}: it cannot promote a version")


def _candidates(rows: Sequence[VerdictRow]) -> str:
    """List the first verdicts with as many characters of their digests as distinguish all of them."""
    digests = [verdict_digest(row.id) for row in rows]
    lengths = range(SHORT_VERDICT, max(map(len, digests)) + 1)
    length = next((digits for digits in lengths if len({digest[:digits] for digest in digests}) == len(rows)), None)
    listed = [
        f"{row.id if length is None else digest[:length]} ({row.league}@{row.candidate} against {row.champion})"
        for row, digest in zip(rows[:MAX_LISTED], digests, strict=False)
    ]
    more = f" and {len(rows) - MAX_LISTED} more" if len(rows) > MAX_LISTED else ""
    return ", ".join(listed) + more


def _locked(session: Session, verdict: str) -> VerdictRow:
    return session.get(VerdictRow, verdict, with_for_update=True) or _unknown(verdict)


def _unknown(verdict: str) -> VerdictRow:
    raise UnknownVerdict(f"there is no verdict {verdict!r}")
