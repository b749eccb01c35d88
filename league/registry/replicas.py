"""What serving replicas report: that they run, the versions that they serve, and their metrics.

All times are those of the database's clock, because the clocks of replicas may differ.
"""

from collections.abc import Iterable, Mapping
from datetime import timedelta
from types import MappingProxyType
from typing import Any

from sqlalchemy import and_, delete, select, update
from sqlalchemy.orm import Session

from league.registry import leagues, traffic
from league.registry.storage.database import Repository, clock, insert, row_count, upsert
from league.registry.storage.rows import Acknowledgement, RegisteredReplica, ShadowCounts, detached
from league.registry.storage.tables import AcknowledgementTable, ReplicaReportTable, ReplicaTable

KEPT = timedelta(days=1)
"""Replicas that died without deregistering are removed after this time, unless another replica notices earlier."""
LIVENESS_TIMEOUT = timedelta(seconds=15)
"""A replica without a report for longer is silent: dead, stuck, or cut off from the database."""


class ReplicaRepository(Repository):
    """Writes and reads the reports of replicas."""

    def register(self, replica: str, process: Mapping[str, str]) -> None:
        """Record that a replica runs, and remove replicas that have been silent for KEPT.

        A replica registers before it reads the aliases for the first time, and then repeatedly.
        process: where it runs; see RegisteredReplica.
        """
        with self._database.write() as session:
            now = clock(session)
            upsert(session, ReplicaTable, {"replica": replica}, {"process": dict(process), "seen_at": now})
            for old in session.scalars(select(ReplicaTable.replica).where(ReplicaTable.seen_at < now - KEPT)).all():
                _remove(session, old)

    def registered(self) -> list[RegisteredReplica]:
        """Return all replicas that have registered and were not removed."""
        with self._database.read() as session:
            now = clock(session)
            found = session.scalars(select(ReplicaTable).order_by(ReplicaTable.replica))
            return [detached(RegisteredReplica, row, silence=now - row.seen_at) for row in found]

    def acknowledge(
        self,
        replica: str,
        league: str,
        version: int | None,
        sha256: str | None,
        fault: str | None = None,
        aliases: Mapping[str, int] = MappingProxyType({}),
        traffic: int | None = None,
        event: int | None = None,
    ) -> None:
        """Replace the acknowledgement of a replica for a league. Raises UnknownLeague.

        version, sha256: the champion that it serves. fault: why it does not serve what it should. aliases: alias →
        version that it serves. traffic: id of the traffic setting that it follows. event: id of the newest alias event
        of the league that it has read.
        """
        values = {
            "version": version,
            "sha256": sha256,
            "fault": fault,
            "aliases": dict(aliases),
            "traffic": traffic,
            "event": event,
        }
        with self._database.write() as session:
            leagues.require(session, league)
            now = clock(session)
            upsert(session, AcknowledgementTable, {"replica": replica, "league": league}, values | {"seen_at": now})
            seen = update(ReplicaTable).filter_by(replica=replica).values(seen_at=now)
            if not row_count(session, seen):  # another replica took it for dead
                insert(session, ReplicaTable, [{"replica": replica, "process": {}, "seen_at": now}])

    def acknowledgements(self, league: str) -> list[Acknowledgement]:
        """Return what each registered replica serves of a league, by replica. Raises UnknownLeague."""
        with self._database.read() as session:
            return acknowledgements(session, league)

    def write_report(self, replica: str, document: dict[str, Any], counts: Iterable[ShadowCounts] = ()) -> None:
        """Replace the metrics report of a replica and its shadow counters since it started."""
        with self._database.write() as session:
            values = {"document": document, "at": clock(session)}
            upsert(session, ReplicaReportTable, {"replica": replica}, values)
            traffic.write_shadow_counts(session, replica, counts)

    def reports(self, since: timedelta = LIVENESS_TIMEOUT) -> dict[str, dict[str, Any]]:
        """Return replica → its metrics report, of the replicas that wrote one in the last `since`."""
        table = ReplicaReportTable
        with self._database.read() as session:
            query = select(table).where(table.at >= clock(session) - since).order_by(table.replica)
            return {report.replica: report.document for report in session.scalars(query)}

    def remove(self, replica: str) -> None:
        """Remove a replica that has ended, its acknowledgements and its metrics report, and outdated reports."""
        with self._database.write() as session:
            _remove(session, replica)
            session.execute(delete(ReplicaReportTable).where(ReplicaReportTable.at < clock(session) - KEPT))


def acknowledgements(session: Session, league: str) -> list[Acknowledgement]:
    """Return what each registered replica serves of a league, by replica. Raises UnknownLeague."""
    leagues.require(session, league)
    now = clock(session)
    of_league = and_(AcknowledgementTable.replica == ReplicaTable.replica, AcknowledgementTable.league == league)
    query = select(ReplicaTable, AcknowledgementTable).outerjoin(AcknowledgementTable, of_league)
    nothing = AcknowledgementTable(league=league, aliases={})
    return [
        detached(
            Acknowledgement,
            row or nothing,
            replica=replica.replica,
            seen_at=replica.seen_at,
            silence=now - replica.seen_at,
        )
        for replica, row in session.execute(query.order_by(ReplicaTable.replica)).tuples()
    ]


def _remove(session: Session, replica: str) -> None:
    for table in (ReplicaTable, AcknowledgementTable, ReplicaReportTable):
        session.execute(delete(table).filter_by(replica=replica))
