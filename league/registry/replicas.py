"""What serving replicas report: that they run, what they have read, what they serve, and their metrics.

A replica has one row that says how far it has read the changes of the registry. It serves what the registry required
then, except of leagues for which it has an acknowledgement as well: while a version is loaded, or after a
failure. So following a change, or 1,000 of them, is one update.

All times are those of the database's clock, because the clocks of replicas may differ.
"""

from collections.abc import Collection, Mapping
from dataclasses import asdict, fields
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, Join, and_, bindparam, case, delete, func, select, true, update
from sqlalchemy.orm import Session

from league.refs import CHAMPION
from league.registry import leagues, processes, traffic
from league.registry.storage.database import (
    Repository,
    clock,
    insert,
    reading,
    row_count,
    sql_clock,
    upsert,
    upsert_all,
    writing,
)
from league.registry.storage.rows import (
    Acknowledgement,
    AliasEvent,
    AliasTarget,
    ReadPosition,
    RegisteredReplica,
    ServedState,
    ShadowCounts,
)
from league.registry.storage.tables import (
    AcknowledgementTable,
    AliasTable,
    ReplicaReportTable,
    ReplicaTable,
    VersionTable,
)

KEPT = timedelta(days=1)
"""Replicas that died without deregistering are removed after this time, unless another replica notices earlier."""
LIVENESS_TIMEOUT = timedelta(seconds=15)
"""A replica without a report for longer is silent: dead, stuck, or cut off from the database."""
PROCESS = "process"
"""Key in the description of a process, for its identity, see `league.registry.processes`."""
URL = "url"
"""Key in the description of a process, for the URL at which programs of its machine reach it without a proxy."""
DRAINING = "draining"
"""Key in the description of a process, for a replica that is being stopped."""
_UPDATE = update(ReplicaTable).where(ReplicaTable.replica == bindparam("name"))
_UPDATE_NOW = _UPDATE.values(seen_at=func.clock_timestamp())
"""Built once, since replicas execute them again and again."""


STATE = [state.name for state in fields(ServedState)]


class ReplicaCounts(NamedTuple):
    """Numbers of replicas.

    Attributes:
        registered: Replicas that have registered and were not removed.
        silent: Those of them that are silent.
        draining: Those of them that are being stopped and get no new requests.
    """

    registered: int
    silent: int
    draining: int


class ReplicaRepository(Repository):
    """Writes and reads the reports of replicas."""

    def register(self, replica: str, process: Mapping[str, str], is_draining: bool = False) -> bool:
        """Record that a replica runs.

        A replica registers before it reads the aliases for the first time, and then repeatedly.
        process: where it runs; see RegisteredReplica. is_draining: whether it is being stopped. Returns whether it was
        registered already; if not, nothing that it has acknowledged is known.
        """
        process = dict(process) | ({DRAINING: "true"} if is_draining else {})
        if self._update(replica, {"process": process}):
            return True
        with self._database.write() as session:
            _remove(session, replica)
            insert(session, ReplicaTable, [{"replica": replica, "process": process, "seen_at": clock(session)}])
        return False

    @reading
    def registered(self, session: Session) -> list[RegisteredReplica]:
        """Return all replicas that have registered and were not removed."""
        return _registered(session, true())

    def counts(self, silence: timedelta = LIVENESS_TIMEOUT) -> ReplicaCounts:
        """Return how many replicas have registered and were not removed, are silent, and are being stopped.

        silence: the time without a report after which a replica counts as silent.
        """
        current_time = datetime.now(UTC) if self._database.is_sqlite else func.clock_timestamp()
        silent = func.count().filter(ReplicaTable.seen_at <= current_time - silence)
        draining = func.count().filter(ReplicaTable.process[DRAINING].as_string() == "true")
        (row,) = self._database.rows(select(func.count(), silent, draining).select_from(ReplicaTable))
        return ReplicaCounts(*row)

    @reading
    def silent(self, session: Session, silence: timedelta = LIVENESS_TIMEOUT) -> list[RegisteredReplica]:
        """Return the registered replicas without a report for this time."""
        return _registered(session, ReplicaTable.seen_at <= sql_clock(session) - silence)

    def remove_ended(self) -> None:
        """Remove the replicas of this machine whose processes have ended without deregistering."""
        is_local = ReplicaTable.process[PROCESS].as_string().startswith(f"{processes.this_machine()}:", autoescape=True)
        with self._database.read() as session:
            local = _registered(session, is_local)
        for replica in local:
            if processes.has_ended(replica.process[PROCESS]):
                self.remove(replica.replica)

    def acknowledge(
        self,
        replica: str,
        position: ReadPosition,
        differing: Mapping[str, ServedState],
        settled: Collection[str] | None = None,
    ) -> bool:
        """Record what a registered replica has read, and what it serves of leagues where this differs.

        position: how far it has read.
        differing: league → what it serves. settled: leagues that differed at an earlier call, and do not any
        more; None: all others.
        Returns False, and records nothing, if the replica is not registered: another one took it for dead.
        """
        if not differing and settled is not None and not settled:
            return self._update(replica, position._asdict())
        with self._database.write() as session:
            report = {"seen_at": sql_clock(session)} | position._asdict()
            if not row_count(session, update(ReplicaTable).filter_by(replica=replica).values(report)):
                return False
            earlier = delete(AcknowledgementTable).filter_by(replica=replica)
            if settled is None:
                session.execute(earlier)
            elif settled:
                session.execute(earlier.where(AcknowledgementTable.league.in_(settled)))
            if differing:
                reported_at = clock(session)
                rows = [
                    {"replica": replica, "league": league, "seen_at": reported_at} | asdict(state)
                    for league, state in differing.items()
                ]
                upsert_all(session, AcknowledgementTable, ("replica", "league"), rows)
            return True

    @reading
    def acknowledgements(self, session: Session, league: str) -> list[Acknowledgement]:
        """Return what each registered replica serves of a league, by replica. Raises UnknownLeague."""
        leagues.require(session, league)
        current_time = clock(session)

        @cache
        def state_at(event: int | None, setting: int | None) -> ServedState:
            """What the registry required when `event` and `setting` were the newest that a replica had read."""
            if event is None:
                return ServedState()
            targets = _aliases_at(session, league, event)
            aliases = {alias: target.version for alias, target in targets.items()}
            version = aliases.get(CHAMPION)
            followed = traffic.setting_at(session, league, setting or 0)
            pinned = () if followed is None else (followed.canary, followed.shadow)
            numbers = {str(one.version): one.version for one in pinned if one and isinstance(one.version, int)}
            return ServedState(
                version=version,
                sha256=session.scalar(select(VersionTable.sha256).filter_by(league=league, number=version)),
                aliases=aliases | numbers,
                event=max((target.event for target in targets.values()), default=None),
                traffic=followed.id if followed else None,
            )

        query = select(ReplicaTable, AcknowledgementTable).select_from(with_acknowledgement(league))
        return [
            Acknowledgement(
                **{name: getattr(row or state_at(replica.event, replica.traffic), name) for name in STATE},
                replica=replica.replica,
                league=league,
                seen_at=replica.seen_at,
                silence=current_time - replica.seen_at,
            )
            for replica, row in session.execute(query.order_by(ReplicaTable.replica))
        ]

    @writing
    def write_report(
        self, session: Session, replica: str, document: dict[str, Any], counts: Collection[ShadowCounts] = ()
    ) -> None:
        """Replace the metrics report of a replica and its shadow counters since it started."""
        values = {"document": document, "at": sql_clock(session)}
        upsert(session, ReplicaReportTable, {"replica": replica}, values)
        traffic.write_shadow_counts(session, replica, counts)

    @reading
    def reports(self, session: Session, since: timedelta = LIVENESS_TIMEOUT) -> dict[str, dict[str, Any]]:
        """Return replica → its metrics report, of the replicas that wrote one in the last `since`."""
        table = ReplicaReportTable
        query = select(table).where(table.at >= clock(session) - since).order_by(table.replica)
        return {report.replica: report.document for report in session.scalars(query)}

    @writing
    def remove(self, session: Session, replica: str) -> None:
        """Remove a replica that has ended, its acknowledgements and its metrics report, and outdated reports."""
        _remove(session, replica)
        session.execute(delete(ReplicaReportTable).where(ReplicaReportTable.at < clock(session) - KEPT))

    def _update(self, replica: str, values: Mapping[str, Any]) -> bool:
        """Set values of a registered replica, which is alive now. Returns False if it is not registered."""
        if self._database.is_sqlite:
            return self._database.execute(_UPDATE, {"name": replica, "seen_at": datetime.now(UTC), **values}) > 0
        return self._database.execute(_UPDATE_NOW, {"name": replica, **values}) > 0


def with_acknowledgement(league: str) -> Join:
    """The registered replicas, each with its acknowledgement for a league, or nulls."""
    table = ReplicaTable.__table__
    of_league = and_(AcknowledgementTable.replica == ReplicaTable.replica, AcknowledgementTable.league == league)
    return table.outerjoin(AcknowledgementTable.__table__, of_league)


def serving(session: Session, league: str, since: timedelta) -> dict[int, int]:
    """Return version → number of replicas that serve it as champion and have reported in the last `since`."""
    newest = func.coalesce(select(func.max(AliasTable.event)).filter_by(league=league).scalar_subquery(), 0)
    # All that have read the newest event of the league are one group.
    read = case(
        (AcknowledgementTable.replica.is_not(None), None),
        (ReplicaTable.event >= newest, newest),
        else_=ReplicaTable.event,
    )
    groups = (
        select(AcknowledgementTable.version, read, func.count())
        .select_from(with_acknowledgement(league))
        .where(ReplicaTable.seen_at > sql_clock(session) - since)
        .group_by(AcknowledgementTable.version, read)
    )
    replica_counts: dict[int, int] = {}
    for acknowledged, event, number in session.execute(groups):
        champion = None if event is None else _aliases_at(session, league, event).get(CHAMPION)
        version = champion.version if champion else acknowledged
        if version is not None:
            replica_counts[version] = replica_counts.get(version, 0) + number
    return dict(sorted(replica_counts.items()))


def _aliases_at(session: Session, league: str, event: int) -> dict[str, AliasTarget]:
    """Return alias → its target when `event` was the newest."""
    query = select(AliasTable.name, AliasTable.version, AliasTable.event).filter_by(league=league)
    targets = {alias: AliasTarget(version, moved) for alias, version, moved in session.execute(query)}
    for alias in [alias for alias, target in targets.items() if target.event > event]:
        del targets[alias]
        table = AliasEvent
        earlier = select(table.version, table.id).filter_by(league=league, alias=alias).where(table.id <= event)
        if target := session.execute(earlier.order_by(table.id.desc()).limit(1)).one_or_none():
            targets[alias] = AliasTarget(*target)
    return targets


def _registered(session: Session, condition: ColumnElement[bool]) -> list[RegisteredReplica]:
    rows = session.scalars(select(ReplicaTable).where(condition).order_by(ReplicaTable.replica)).all()
    if not rows:
        return []
    current_time = clock(session)
    return [RegisteredReplica(row.replica, row.process, row.seen_at, current_time - row.seen_at) for row in rows]


def _remove(session: Session, replica: str) -> None:
    for table in (ReplicaTable, AcknowledgementTable, ReplicaReportTable):
        session.execute(delete(table).filter_by(replica=replica))
