"""What serving replicas report: acknowledgements of the versions that they serve, and their metrics."""

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta
from types import MappingProxyType
from typing import Any

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from league.registry import leagues, traffic
from league.registry.storage.database import Repository, upsert
from league.registry.storage.rows import Acknowledgement, ShadowCounts, detached
from league.registry.storage.tables import AcknowledgementTable, ReplicaReportTable

KEPT = timedelta(days=1)
"""Reports of replicas that died without unregistering are deleted after this time."""
LIVENESS_TIMEOUT = timedelta(seconds=15)
"""A replica without a report for longer is considered dead."""


class ReplicaRepository(Repository):
    """Writes and reads the reports of replicas."""

    def acknowledge(
        self,
        replica: str,
        league: str,
        version: int | None,
        sha256: str | None,
        fault: str | None = None,
        aliases: Mapping[str, int] = MappingProxyType({}),
        traffic: int | None = None,
    ) -> None:
        """Replace the acknowledgement of a replica for a league. Raises UnknownLeague.

        version, sha256: the champion that it serves. fault: why it does not serve what it should. aliases: alias →
        version that it serves. traffic: id of the traffic setting that it follows.
        """
        now = datetime.now(UTC)
        values = {"version": version, "sha256": sha256, "fault": fault, "aliases": dict(aliases), "traffic": traffic}
        with self._database.write() as session:
            leagues.require(session, league)
            key = {"replica": replica, "league": league}
            upsert(session, AcknowledgementTable, key, values | {"seen_at": now})
            session.execute(delete(AcknowledgementTable).where(AcknowledgementTable.seen_at < now - KEPT))

    def acknowledgements(self, league: str, since: timedelta = LIVENESS_TIMEOUT) -> list[Acknowledgement]:
        """Return the acknowledgements of a league from the last `since`, by replica. Raises UnknownLeague."""
        with self._database.read() as session:
            return acknowledgements(session, league, since)

    def live(self, since: timedelta = LIVENESS_TIMEOUT) -> list[str]:
        """Return the replicas with an acknowledgement, of any league, in the last `since`."""
        table = AcknowledgementTable
        query = select(table.replica).where(table.seen_at >= datetime.now(UTC) - since).distinct()
        with self._database.read() as session:
            return sorted(session.scalars(query))

    def write_report(self, replica: str, document: dict[str, Any], counts: Iterable[ShadowCounts] = ()) -> None:
        """Replace the metrics report of a replica and its shadow counters since it started."""
        with self._database.write() as session:
            values = {"document": document, "at": datetime.now(UTC)}
            upsert(session, ReplicaReportTable, {"replica": replica}, values)
            traffic.write_shadow_counts(session, replica, counts)

    def reports(self, since: timedelta = LIVENESS_TIMEOUT) -> dict[str, dict[str, Any]]:
        """Return replica → its metrics report, of the replicas that wrote one in the last `since`."""
        table = ReplicaReportTable
        query = select(table).where(table.at >= datetime.now(UTC) - since).order_by(table.replica)
        with self._database.read() as session:
            return {report.replica: report.document for report in session.scalars(query)}

    def remove(self, replica: str) -> None:
        """Remove the acknowledgements and the metrics report of a replica that stops, and outdated reports."""
        with self._database.write() as session:
            session.execute(delete(AcknowledgementTable).filter_by(replica=replica))
            is_stale = ReplicaReportTable.at < datetime.now(UTC) - KEPT
            session.execute(delete(ReplicaReportTable).where((ReplicaReportTable.replica == replica) | is_stale))


def acknowledgements(session: Session, league: str, since: timedelta) -> list[Acknowledgement]:
    """Return the acknowledgements of a league from the last `since`, by replica. Raises UnknownLeague."""
    leagues.require(session, league)
    table = AcknowledgementTable
    query = select(table).filter_by(league=league).order_by(table.replica)
    found = session.scalars(query.where(table.seen_at >= datetime.now(UTC) - since))
    return [detached(Acknowledgement, row) for row in found]
