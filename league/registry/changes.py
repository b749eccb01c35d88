"""Change tokens of leagues, and waiting until all replicas follow a change."""

import time
from collections import Counter
from collections.abc import Callable
from datetime import timedelta

from sqlalchemy import func, select

from league.errors import AliasMoved, Conflict, NotReady
from league.registry import aliases, evaluations, replicas
from league.registry.aliases import AliasRepository
from league.registry.replicas import LIVENESS_TIMEOUT, ReplicaRepository
from league.registry.storage.database import Database, Repository
from league.registry.storage.rows import Acknowledgement, AliasEvent, ChangeToken, Traffic
from league.registry.storage.tables import (
    READY,
    AliasEventTable,
    EvaluationTable,
    RunTable,
    SnapshotTable,
    TrafficEventTable,
    VerdictTable,
    VersionNoteTable,
    VersionTable,
)
from league.registry.traffic import TrafficRepository
from league.registry.training import runs

OPEN = "open"
POLL_SECONDS = 0.02


class ChangeRepository(Repository):
    """Computes change tokens and waits for replicas."""

    def __init__(self, database: Database) -> None:
        super().__init__(database)
        self._aliases = AliasRepository(database)
        self._traffic = TrafficRepository(database)
        self._replicas = ReplicaRepository(database)

    def token(self, league: str, since: timedelta = LIVENESS_TIMEOUT) -> ChangeToken:
        """Return the change token of a league, which differs after any change. Raises UnknownLeague.

        Cheap enough for polling: each query reads the end of an index, or a few rows.
        since: how old the last report of a live replica may be.
        """
        outcomes = select(VerdictTable.outcome, func.count()).filter_by(league=league).group_by(VerdictTable.outcome)
        newest_run = select(RunTable.id).filter_by(league=league).order_by(RunTable.began_at.desc(), RunTable.id.desc())
        with self._database.read() as session:
            acknowledged = replicas.acknowledgements(session, league)
            serving = Counter(each.version for each in acknowledged if each.version and each.silence < since)
            return ChangeToken(
                league=league,
                aliases=aliases.current(session, league),
                event=session.scalar(select(func.max(AliasEventTable.id)).filter_by(league=league)),
                version=session.scalar(select(func.max(VersionTable.number)).filter_by(league=league, state=READY)),
                note=session.scalar(select(func.max(VersionNoteTable.id)).filter_by(league=league)),
                traffic=session.scalar(select(func.max(TrafficEventTable.id)).filter_by(league=league)),
                serving=dict(sorted(serving.items())),
                verdicts={outcome or OPEN: count for outcome, count in session.execute(outcomes)},
                evaluation=session.scalar(select(func.max(EvaluationTable.id)).filter_by(league=league)),
                evaluations=evaluations.active(session, league),
                run=session.scalar(newest_run.limit(1)),
                runs=runs.active(session, league),
                computed_at=session.scalar(select(func.max(SnapshotTable.at)).filter_by(league=league)),
            )

    def wait_for_alias(
        self, event: AliasEvent, timeout: float, sleep: Callable[[float], None] = time.sleep
    ) -> list[str]:
        """Wait until all registered replicas, at least one, follow the move of an alias, and return them.

        A replica is waited for until it deregisters, or is removed because its process has ended: one that does not
        respond, or cannot reach the database, may still serve another version.
        timeout: in seconds. Raises AliasMoved if the alias points elsewhere by now, or NotReady, which names the
        replicas that do not follow, and why.
        """
        league, alias, version = event.league, event.alias, event.version

        def check() -> None:
            if (now := self._aliases.current(league).get(alias)) != version:
                raise AliasMoved(f"{league}@{alias} was set to version {now} in the meantime")

        return self._wait(
            league,
            f"{league}@{alias} is version {version}",
            check=check,
            follows=lambda found: (found.event or 0) >= event.id and found.aliases.get(alias) == version,
            describe=lambda found: _serves(found, alias),
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

        def check() -> None:
            if self._traffic.current(setting.league).id != setting.id:
                raise Conflict(f"the traffic of {setting.league} was changed in the meantime")

        return self._wait(
            setting.league,
            f"the traffic of {setting.league} is set",
            check=check,
            follows=lambda found: found.traffic == setting.id,
            describe=lambda found: found.fault or "has not applied the setting",
            timeout=timeout,
            sleep=sleep,
        )

    def _wait(
        self,
        league: str,
        done: str,
        *,
        check: Callable[[], None],
        follows: Callable[[Acknowledgement], bool],
        describe: Callable[[Acknowledgement], str],
        timeout: float,
        sleep: Callable[[float], None],
    ) -> list[str]:
        """Poll until all replicas follow. `check` raises if they never will; `describe` says why one does not."""
        deadline = time.monotonic() + timeout
        while True:
            check()
            found = self._replicas.acknowledgements(league)
            late = [one for one in found if not follows(one)]
            if found and not late:
                return [one.replica for one in found]
            if time.monotonic() >= deadline:
                reasons = [f"{one.replica} {_silence(one)}{describe(one)}" for one in late]
                raise NotReady(f"{done}, but after {timeout:g} s {_why(len(found), reasons)}")
            sleep(POLL_SECONDS)


def _why(registered: int, reasons: list[str]) -> str:
    if not registered:
        return "no replica has reported: is a server running on this registry?"
    return f"{len(reasons)} of {registered} replicas have not confirmed it: {'; '.join(reasons)}"


def _silence(found: Acknowledgement) -> str:
    if found.silence < LIVENESS_TIMEOUT:
        return ""
    return f"has been silent for {found.silence.total_seconds():.0f} s; last known: "


def _serves(found: Acknowledgement, alias: str) -> str:
    if found.event is None:
        return "has not reported on this league"
    number = found.aliases.get(alias)
    serves = "serves nothing" if number is None else f"serves version {number}"
    return f"{serves} ({found.fault})" if found.fault else serves
