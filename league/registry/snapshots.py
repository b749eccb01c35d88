"""Snapshots: what pages show of a league, computed ahead of time, each with a mark of what it was computed from.

A league's mark is another as soon as anything is that its standings, ratings or verdicts follow from.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Executable, func, select
from sqlalchemy.orm import Session

from league.interface import digest
from league.refs import CHAMPION
from league.registry import leagues, rows
from league.registry.database import upsert
from league.registry.tables import READY, AliasEvent, League, Match, Schedule, Snapshot, Verdict, Version
from league.registry.verdicts import VOID

SUMMARY = "summary"
"""The part that has a league's newest mark when all parts are up to date."""
FORMAT = 1
"""Of the documents: with another one all are computed anew."""
_COUNTS: dict[str, Executable] = {
    "matches": select(Match.league, func.count()).group_by(Match.league),
    "purged schedules": select(Schedule.league, func.count())
    .where(Schedule.purged_at.is_not(None))
    .group_by(Schedule.league),
    "versions": select(Version.league, func.count()).filter_by(state=READY).group_by(Version.league),
    "promotions": select(AliasEvent.league, func.count()).filter_by(alias=CHAMPION).group_by(AliasEvent.league),
    "verdicts, closed, void": select(
        Verdict.league, func.count(), func.count(Verdict.outcome), func.count().filter(Verdict.outcome == VOID)
    ).group_by(Verdict.league),
}
"""Each grows whenever something is that a snapshot follows from: nothing of it is ever removed or changed."""


def one(session: Session, league: str, part: str) -> rows.SnapshotRow | None:
    """A part of a league's, None if it was not computed yet. Raises UnknownLeague."""
    snapshot = session.get(Snapshot, (league, part))
    if snapshot is None:
        leagues.require(session, league)
        return None
    return _row(snapshot)


def of_part(session: Session, part: str) -> dict[str, rows.SnapshotRow]:
    """league → the same part, of all leagues that have it."""
    found = session.scalars(select(Snapshot).filter_by(part=part).order_by(Snapshot.league))
    return {snapshot.league: _row(snapshot) for snapshot in found}


def reasons(session: Session, league: str, verdicts: Collection[str]) -> dict[str, tuple[str, str]]:
    """verdict → outcome and reason in its judgement, of those that have one. The rest, which is long, is not read."""
    parts = {f"verdict/{verdict}": verdict for verdict in verdicts}
    told = (Snapshot.document[name].as_string() for name in ("outcome", "reason"))
    found = session.execute(select(Snapshot.part, *told).where(Snapshot.league == league, Snapshot.part.in_(parts)))
    return {parts[part]: (outcome, reason) for part, outcome, reason in found}


def computed_from(session: Session, league: str) -> dict[str, str]:
    """part → mark, of all that a league has."""
    found = session.execute(select(Snapshot.part, Snapshot.mark).filter_by(league=league))
    return dict(found.tuples().all())


def put(session: Session, league: str, documents: Mapping[str, Any], mark: str) -> None:
    """Replace these parts of a league's, all or none."""
    leagues.require(session, league)
    now = datetime.now(UTC)
    for part, document in documents.items():
        upsert(session, Snapshot, {"league": league, "part": part}, {"mark": mark, "document": document, "at": now})


def marks(session: Session) -> dict[str, str]:
    """league → its mark now. The ledger is counted on its index, nothing of it is read."""
    counts: defaultdict[str, list[Any]] = defaultdict(list)
    for name, query in _COUNTS.items():
        for league, *values in session.execute(query):
            counts[league].append(f"{name}: {' '.join(map(str, values))}")
    registered = session.execute(select(League.slug, League.config, League.interface).order_by(League.slug))
    return {
        league: "; ".join([str(FORMAT), digest({"config": config, "interface": interface})[:12], *counts[league]])
        for league, config, interface in registered
    }


def stale(session: Session) -> list[str]:
    """The leagues whose snapshots are not up to date: those without any first, then the oldest ones."""
    found = session.execute(select(Snapshot.league, Snapshot.mark, Snapshot.at).filter_by(part=SUMMARY))
    known = {league: (mark, at) for league, mark, at in found}
    behind = [league for league, mark in marks(session).items() if league not in known or known[league][0] != mark]
    never = datetime.min.replace(tzinfo=UTC)
    return sorted(behind, key=lambda league: known[league][1] if league in known else never)


def _row(snapshot: Snapshot) -> rows.SnapshotRow:
    return rows.SnapshotRow(document=snapshot.document, mark=snapshot.mark, at=snapshot.at)
