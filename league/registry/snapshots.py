"""Precomputed documents for web pages, each with the change token of the data that it was computed from.

The change token differs after each change of data that leaderboard, ratings or verdicts depend on.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from operator import itemgetter
from typing import Any

from sqlalchemy import Select, func, literal_column, select, union_all
from sqlalchemy.orm import Session

from league.interface import digest
from league.refs import CHAMPION
from league.registry import leagues
from league.registry.storage.database import Repository, reading, upsert, writing
from league.registry.storage.rows import AliasEvent, LeagueRow, SnapshotRow, VerdictRow
from league.registry.storage.tables import READY, ScheduleTable, ScheduleTotalTable, VersionTable
from league.registry.verdicts import VOID

SUMMARY = "summary"
"""The part that has a league's newest mark when all parts are up to date."""
FORMAT = 2
"""Version of the documents and of how their numbers are computed. A new one invalidates all snapshots."""


def earlier_part(conditions: str, part: str) -> str:
    """Return the name of a part about results under earlier conditions (`Conditions.name`)."""
    return f"earlier/{conditions}/{part}"


_COUNTS: dict[str, Select[*tuple[Any, ...]]] = {
    "matches": select(ScheduleTotalTable.league, func.sum(ScheduleTotalTable.matches))
    .where(ScheduleTotalTable.matches > 0)
    .group_by(ScheduleTotalTable.league),
    "purged schedules": select(ScheduleTable.league, func.count())
    .where(ScheduleTable.purged_at.is_not(None))
    .group_by(ScheduleTable.league),
    "versions": select(VersionTable.league, func.count()).filter_by(state=READY).group_by(VersionTable.league),
    "promotions": select(AliasEvent.league, func.count()).filter_by(alias=CHAMPION).group_by(AliasEvent.league),
    "verdicts, closed, void": select(
        VerdictRow.league,
        func.count(),
        func.count(VerdictRow.outcome),
        func.count().filter(VerdictRow.outcome == VOID),
    ).group_by(VerdictRow.league),
}
"""Counts that grow with every change of the data behind a snapshot: none of these rows is deleted or changed."""
_WIDTH = max(len(query.selected_columns) for query in _COUNTS.values())
_ALL_COUNTS = union_all(
    *(
        query.add_columns(*[literal_column("0")] * (_WIDTH - len(query.selected_columns)), literal_column(str(number)))
        for number, query in enumerate(_COUNTS.values())
    )
)
"""All of them in one query: league, counts, zeros up to _WIDTH columns, and the position in _COUNTS."""
_REGISTERED = select(
    LeagueRow.slug, LeagueRow.config_document, LeagueRow.interface_document, LeagueRow.game_digest
).order_by(LeagueRow.slug)


class SnapshotRepository(Repository):
    """Writes and reads snapshots, and finds outdated ones."""

    @reading
    def get(self, session: Session, league: str, part: str) -> SnapshotRow | None:
        """Return a part of a league's snapshots, None if it was not computed yet. Raises UnknownLeague."""
        snapshot = session.get(SnapshotRow, (league, part))
        if snapshot is None:
            leagues.require(session, league)
            return None
        return snapshot

    def current(self, league: str, part: str) -> SnapshotRow | None:
        """Return a part that was computed from the league's current data, else None. Raises UnknownLeague."""
        snapshot = self.get(league, part)
        return snapshot if snapshot is not None and snapshot.mark == self.current_marks()[league] else None

    @reading
    def of_part(self, session: Session, part: str) -> dict[str, SnapshotRow]:
        """Return league → this part, of the leagues that have it."""
        query = select(SnapshotRow).filter_by(part=part).order_by(SnapshotRow.league)
        return {snapshot.league: snapshot for snapshot in session.scalars(query)}

    @reading
    def verdict_reasons(self, session: Session, league: str, verdicts: Collection[str]) -> dict[str, tuple[str, str]]:
        """Return verdict → outcome and reason in its snapshot, of the verdicts that have one.

        The rest of the documents, which is long, is not read.
        """
        parts = {f"verdict/{verdict}": verdict for verdict in verdicts}
        fields = (SnapshotRow.document[name].as_string() for name in ("outcome", "reason"))
        query = select(SnapshotRow.part, *fields)
        query = query.where(SnapshotRow.league == league, SnapshotRow.part.in_(parts))
        return {parts[part]: (outcome, reason) for part, outcome, reason in session.execute(query)}

    @reading
    def marks(self, session: Session, league: str) -> dict[str, str]:
        """Return part → the mark that it was computed from, of all parts of a league."""
        rows = session.execute(select(SnapshotRow.part, SnapshotRow.mark).filter_by(league=league))
        return dict(rows.tuples().all())

    @writing
    def put(self, session: Session, league: str, documents: Mapping[str, Any], mark: str) -> None:
        """Replace these parts of a league's snapshots, all or none. Raises UnknownLeague.

        mark: of the data that they were computed from.
        """
        stored_at = datetime.now(UTC)
        leagues.require(session, league)
        for part, document in documents.items():
            values = {"mark": mark, "document": document, "at": stored_at}
            upsert(session, SnapshotRow, {"league": league, "part": part}, values)

    def current_marks(self) -> dict[str, str]:
        """Return league → the mark of its current data, of all leagues."""
        counts: defaultdict[str, dict[int, str]] = defaultdict(dict)
        names = [(name, len(query.selected_columns)) for name, query in _COUNTS.items()]
        for league, *values, number in self._database.rows(_ALL_COUNTS):
            name, width = names[number]
            counts[league][number] = f"{name}: {' '.join(map(str, values[: width - 1]))}"
        return {
            league: "; ".join([str(FORMAT), digest(values)[:12], *map(itemgetter(1), sorted(counts[league].items()))])
            for league, *values in self._database.rows(_REGISTERED)
        }

    def stale(self) -> list[str]:
        """Return the leagues whose snapshots are outdated: leagues without snapshots first, then the oldest."""
        query = select(SnapshotRow.league, SnapshotRow.mark, SnapshotRow.at).filter_by(part=SUMMARY)
        snapshots = {league: (mark, at) for league, mark, at in self._database.rows(query)}
        current = self.current_marks()
        behind = [league for league, mark in current.items() if league not in snapshots or snapshots[league][0] != mark]
        never = datetime.min.replace(tzinfo=UTC)
        return sorted(behind, key=lambda league: snapshots[league][1] if league in snapshots else never)
