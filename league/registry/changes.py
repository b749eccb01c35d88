"""Changes: counts for replicas, tokens of leagues, and waiting until all replicas follow one."""

import time
from collections.abc import Callable
from datetime import timedelta

from sqlalchemy import ColumnElement, ScalarSelect, and_, func, or_, select, true
from sqlalchemy.orm import Session

from league.errors import AliasMoved, Conflict, NotReady
from league.registry import aliases, evaluations, replicas
from league.registry.replicas import LIVENESS_TIMEOUT, ReplicaRepository
from league.registry.storage import change_counter
from league.registry.storage.database import Database, Repository, reading
from league.registry.storage.rows import (
    Acknowledgement,
    AliasEvent,
    ChangeCounts,
    ChangeToken,
    EvaluationRow,
    RunRow,
    SnapshotRow,
    Traffic,
    VerdictRow,
)
from league.registry.storage.tables import (
    READY,
    AcknowledgementTable,
    AliasTable,
    ReplicaTable,
    TrafficEventTable,
    VersionNoteTable,
    VersionTable,
)
from league.registry.training import runs

OPEN = "open"
POLL_SECONDS = 0.02
ENDED_SECONDS = 0.3
"""Seconds between two searches for replicas whose processes have ended; most promotions are followed earlier."""


class ChangeRepository(Repository):
    """Counts changes, computes change tokens and waits for replicas."""

    def __init__(self, database: Database) -> None:
        super().__init__(database)
        self._replicas = ReplicaRepository(database)

    def counts(self) -> ChangeCounts:
        """Return how often what replicas follow has changed, by one cheap query.

        What is read afterwards contains all these changes.
        """
        return change_counter.counts(self._database)

    @reading
    def token(self, session: Session, league: str, since: timedelta = LIVENESS_TIMEOUT) -> ChangeToken:
        """Return the change token of a league, which differs after any change. Raises UnknownLeague.

        Cheap enough for polling: each query reads the end of an index, or a few rows.
        since: how old the last report of a live replica may be.
        """
        outcomes = select(VerdictRow.outcome, func.count()).filter_by(league=league).group_by(VerdictRow.outcome)
        newest_run = select(RunRow.id).filter_by(league=league).order_by(RunRow.began_at.desc(), RunRow.id.desc())
        return ChangeToken(
            league=league,
            aliases=aliases.current(session, league),
            event=session.scalar(select(func.max(AliasTable.event)).filter_by(league=league)),
            version=session.scalar(select(func.max(VersionTable.number)).filter_by(league=league, state=READY)),
            note=session.scalar(select(func.max(VersionNoteTable.id)).filter_by(league=league)),
            traffic=session.scalar(select(func.max(TrafficEventTable.id)).filter_by(league=league)),
            serving=replicas.serving(session, league, since),
            verdicts={outcome or OPEN: count for outcome, count in session.execute(outcomes)},
            evaluation=session.scalar(select(func.max(EvaluationRow.id)).filter_by(league=league)),
            evaluations=evaluations.active(session, league),
            run=session.scalar(newest_run.limit(1)),
            runs=runs.active(session, league),
            computed_at=session.scalar(select(func.max(SnapshotRow.at)).filter_by(league=league)),
        )

    def wait_for_alias(
        self, event: AliasEvent, timeout: float, sleep: Callable[[float], None] = time.sleep
    ) -> list[str]:
        """Wait until all registered replicas, at least one, follow the move of an alias, and return them.

        A replica is waited for until it deregisters, or is removed because its process has ended, which is looked for
        here on this machine: one that does not respond, or cannot reach the database, may still serve another version.
        timeout: in seconds. Raises AliasMoved if the alias points elsewhere by now, or NotReady, which names the
        replicas that do not follow, and why.
        """
        league, alias = event.league, event.alias
        current_target = select(AliasTable.version, AliasTable.event).filter_by(league=league, name=alias).subquery()
        acknowledged = AcknowledgementTable

        def check(version: int | None) -> None:
            if version != event.version:
                raise AliasMoved(f"{league}@{alias} was set to version {version} in the meantime")

        return self._wait(
            league,
            f"{league}@{alias} is version {event.version}",
            now=select(current_target.c.version).scalar_subquery(),
            check=check,
            # The alias may have moved away and back since.
            agrees=ReplicaTable.event >= select(current_target.c.event).scalar_subquery(),
            acknowledges=and_(
                acknowledged.event >= event.id, acknowledged.aliases[alias].as_integer() == event.version
            ),
            describe=lambda acknowledgement: _serves(acknowledgement, alias),
            timeout=timeout,
            sleep=sleep,
        )

    def wait_for_traffic(
        self, setting: Traffic, timeout: float, sleep: Callable[[float], None] = time.sleep
    ) -> list[str]:
        """Wait until all registered replicas, at least one, follow a traffic setting, and return them.

        timeout: in seconds. Raises Conflict if there is a newer setting by now, or NotReady, which names the replicas
        that do not follow, and why.
        """

        def check(newest: int | None) -> None:
            if newest != setting.id:
                raise Conflict(f"the traffic of {setting.league} was changed in the meantime")

        return self._wait(
            setting.league,
            f"the traffic of {setting.league} is set",
            now=select(func.max(TrafficEventTable.id)).filter_by(league=setting.league).scalar_subquery(),
            check=check,
            agrees=true(),
            acknowledges=AcknowledgementTable.traffic == setting.id,
            describe=lambda acknowledgement: acknowledgement.fault or "has not applied the setting",
            timeout=timeout,
            sleep=sleep,
        )

    def _wait(
        self,
        league: str,
        done: str,
        *,
        now: ScalarSelect[int | None],
        check: Callable[[int | None], None],
        agrees: ColumnElement[bool],
        acknowledges: ColumnElement[bool],
        describe: Callable[[Acknowledgement], str],
        timeout: float,
        sleep: Callable[[float], None],
    ) -> list[str]:
        """Poll until all replicas follow: they have read the change and agree, or acknowledge it for the league.

        `now` is what the change has set, and `check` raises if it was changed again; both are read by the statement
        that counts replicas. `describe` says why a replica does not follow.
        """
        # Ids of events can be used again after a league was removed; counts cannot.
        has_read = ReplicaTable.changes >= self.counts().to_acknowledge
        follows = or_(and_(AcknowledgementTable.replica.is_(None), has_read, agrees), acknowledges)
        count = select(func.count(), func.count().filter(follows), now).select_from(
            replicas.with_acknowledgement(league)
        )
        deadline = time.monotonic() + timeout
        next_search = time.monotonic() + ENDED_SECONDS
        while True:
            ((registered, following, current),) = self._database.rows(count)
            check(current)
            if registered and following == registered:
                return self._names(league, follows)
            if time.monotonic() >= deadline:
                late = set(self._names(league, follows.is_not(true())))
                reasons = []
                for one in self._replicas.acknowledgements(league):
                    if one.replica in late:
                        is_silent = one.silence >= LIVENESS_TIMEOUT
                        silence = f"has been silent for {one.silence.total_seconds():.0f} s; last known: "
                        reasons.append(f"{one.replica} {silence if is_silent else ''}{describe(one)}")
                problem = (
                    f"{len(reasons)} of {registered} replicas have not confirmed it: {'; '.join(reasons)}"
                    if registered
                    else "no replica has reported: is a server running on this registry?"
                )
                raise NotReady(f"{done}, but after {timeout:g} s {problem}")
            if time.monotonic() >= next_search:
                self._replicas.remove_ended()
                next_search = time.monotonic() + ENDED_SECONDS
            sleep(POLL_SECONDS)

    @reading
    def _names(self, session: Session, league: str, condition: ColumnElement[bool]) -> list[str]:
        query = select(ReplicaTable.replica).select_from(replicas.with_acknowledgement(league)).where(condition)
        return list(session.scalars(query.order_by(ReplicaTable.replica)))


def _serves(found: Acknowledgement, alias: str) -> str:
    if found.event is None:
        return "has not reported on this league"
    number = found.aliases.get(alias)
    serves = "serves nothing" if number is None else f"serves version {number}"
    return f"{serves} ({found.fault})" if found.fault else serves
