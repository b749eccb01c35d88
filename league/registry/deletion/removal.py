"""Removes versions and leagues with everything that depends on them.

    rows that depend deleted, versions abandoned → files removed → rows of versions and league deleted

The first step is one transaction, after which nothing refers to the files. If the process ends before the last step,
the next removal completes it; a publication also completes that of a version. An archived league without versions is
what an interrupted removal of a league leaves.
"""

import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from sqlalchemy import ColumnElement, Executable, Select, and_, delete, exists, func, or_, select, update
from sqlalchemy.orm import InstrumentedAttribute, Session

from league.errors import Conflict
from league.files import disk_errors
from league.refs import CheckpointRef, short_verdict
from league.registry import evaluations, leagues, traffic, versions
from league.registry.publishing import VersionPublisher
from league.registry.storage import change_counter
from league.registry.storage.artifacts import ArtifactStore
from league.registry.storage.database import Database, Repository, reading
from league.registry.storage.manifest import MIXTURE, SEARCH
from league.registry.storage.rows import (
    AliasEvent,
    EvaluationRow,
    LeagueRow,
    NightlyRunRow,
    RunRow,
    ShadowCounts,
    SnapshotRow,
    StrengthRow,
    VerdictRow,
)
from league.registry.storage.tables import (
    ABANDONED,
    DIGEST_BYTES,
    READY,
    STRIPE,
    AliasTable,
    Base,
    GameDigestTable,
    IdempotentCallTable,
    MatchTable,
    PairSumTable,
    ScheduleTable,
    ScheduleTotalTable,
    TrafficEventTable,
    VersionNoteTable,
    VersionTable,
)
from league.registry.training import runs

MAX_NAMED = 3
"""Verdicts, versions or runs that a reason names."""


@dataclass(frozen=True, slots=True)
class RemovalPlan:
    """What is removed.

    Attributes:
        target: `connect_four`, or `connect_four@3`.
        versions: Version → size of its files in bytes.
        aliases: Aliases that are removed.
        verdicts: Ids of verdicts that are removed with their schedules.
        matches: Number of recorded matches that are removed.
        runs: Ids of training runs that are removed, with their files on this machine.
        reasons: What depends on the target, in words; empty if nothing does.
    """

    target: str
    versions: dict[int, int]
    aliases: tuple[str, ...] = ()
    verdicts: tuple[str, ...] = ()
    matches: int = 0
    runs: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()


@dataclass(slots=True)
class _Dependents:
    """Rows that depend on a target, and why they do."""

    aliases: list[str] = field(default_factory=list)
    verdicts: list[str] = field(default_factory=list)
    schedules: set[str] = field(default_factory=set)
    """Schedules of the verdicts, which are deleted as a whole."""
    played: set[str] = field(default_factory=set)
    """Other schedules in which the version takes part. Their matches between others stay."""
    portions: list[str] = field(default_factory=list)
    """`canary` or `shadow`, or both."""
    reasons: list[str] = field(default_factory=list)


class RemovalRepository(Repository):
    """Plans and carries out removals."""

    def __init__(self, database: Database, artifacts: ArtifactStore, home: Path) -> None:
        super().__init__(database)
        self._artifacts, self._home = artifacts, home
        self._publisher = VersionPublisher(database, artifacts)

    @reading
    def plan_version(self, session: Session, ref: CheckpointRef) -> RemovalPlan:
        """Return what the removal of a version removes. Raises UnknownLeague, UnknownVersion or UnknownAlias."""
        version = versions.resolve(session, ref)
        dependents = _dependents_of_version(session, version.league, version.number)
        matches = _count_matches(session, _matches_of(version.ref, dependents))
        return RemovalPlan(
            version.ref,
            {version.number: self._artifacts.size(version.league, version.number)},
            tuple(dependents.aliases),
            tuple(dependents.verdicts),
            matches,
            reasons=tuple(dependents.reasons),
        )

    @reading
    def plan_league(self, session: Session, league: str) -> RemovalPlan:
        """Return what the removal of a league removes. Raises UnknownLeague."""
        leagues.require(session, league)
        numbers = session.scalars(select(VersionTable.number).filter_by(league=league).order_by(VersionTable.number))
        sizes = {number: self._artifacts.size(league, number) for number in numbers}
        aliases = _names(session, AliasTable.name, league)
        verdicts = _names(session, VerdictRow.id, league)
        run_ids = _names(session, RunRow.id, league)
        matches = _count_matches(session, MatchTable.league == league)
        reasons = [
            *(f"the alias {name} is set" for name in aliases),
            *_counted(len(verdicts), "verdict", map(short_verdict, verdicts)),
            *_counted(matches, "recorded match", plural="recorded matches"),
            *_counted(len(run_ids), "training run", run_ids),
        ]
        return RemovalPlan(league, sizes, aliases, verdicts, matches, run_ids, tuple(reasons))

    def remove_version(self, ref: CheckpointRef, *, force: bool = False, actor: str = "league remove") -> RemovalPlan:
        """Remove a version. Its number is never reused, except if its league is removed. Returns what was removed.

        force: also remove what depends on it. actor: who ends its canary or shadow.

        Raises:
            UnknownLeague: The league does not exist.
            UnknownVersion: The version does not exist.
            Conflict: Something depends on it and `force` is false, it is a member of a mixture, a search version plays
                with it, or the league is being trained or evaluated.
            StorageError: A file cannot be removed. The next removal or publication removes it.
        """
        plan = self.plan_version(ref)
        target = CheckpointRef.parse(plan.target)
        assert isinstance(target.version, int)
        with self._database.write() as session:
            leagues.lock(session, target.league)
            versions.require(session, target.league, target.version)
            _require_idle(session, target.league)
            if users := _users_of(session, target.league, target.version):
                names = ", ".join(f"{target.league}@{user}" for user in users)
                raise Conflict(f"{plan.target} is a part of {names}: remove that first")
            dependents = _dependents_of_version(session, target.league, target.version)
            _require_free(plan.target, dependents.reasons, force)
            _delete_dependents(session, target.league, target.version, dependents, actor)
        self._publisher.sweep(target.league)
        return plan

    def remove_league(self, league: str, *, force: bool = False) -> RemovalPlan:
        """Remove a league with all its versions, results and runs. Returns what was removed.

        force: also if it has aliases, verdicts, recorded matches or training runs.

        Raises:
            UnknownLeague: The league does not exist.
            Conflict: It is in use and `force` is false, or it is being trained or evaluated.
            StorageError: A file cannot be removed. The next removal removes it.
        """
        plan = self.plan_league(league)
        with self._database.write() as session:
            row = leagues.lock(session, league)
            _require_idle(session, league)
            _require_free(league, plan.reasons, force)
            row.archived_at = row.archived_at or datetime.now(UTC)
            for subject in ("aliases", "traffic", "leagues"):
                change_counter.count(session, subject)
            call = IdempotentCallTable
            for column, result in (
                (call.event, AliasEvent),
                (call.traffic, TrafficEventTable),
                (call.evaluation, EvaluationRow),
            ):
                session.execute(delete(call).where(column.in_(select(result.id).filter_by(league=league))))
            for table in reversed(Base.metadata.sorted_tables):
                if "league" in table.columns and table.name != VersionTable.__tablename__:
                    session.execute(delete(table).where(table.c.league == league))
            session.execute(update(VersionTable).filter_by(league=league).values(state=ABANDONED, parent=None))
        for number in plan.versions:
            self._artifacts.remove_training(league, number)
            self._artifacts.discard(league, number)
        for directory in (self._home / "runs" / league, self._home / "sweeps" / league):
            with disk_errors(directory), suppress(FileNotFoundError):
                shutil.rmtree(directory)
        report = self._home / "reports" / f"{league}.html"
        with disk_errors(report):
            report.unlink(missing_ok=True)
        with self._database.write() as session:
            session.execute(delete(VersionTable).filter_by(league=league, state=ABANDONED))
            session.execute(delete(LeagueRow).filter_by(slug=league))
        return plan


def _dependents_of_version(session: Session, league: str, number: int) -> _Dependents:
    """Find what depends on a version: aliases, verdicts, recorded matches, other versions, runs and traffic."""
    ref, dependents = f"{league}@{number}", _Dependents()
    dependents.aliases += session.scalars(
        select(AliasTable.name).filter_by(league=league, version=number).order_by(AliasTable.name)
    )
    documents = session.execute(select(ScheduleTable.id, ScheduleTable.document).filter_by(league=league))
    dependents.played = {id_ for id_, document in documents if ref in json.loads(document)["contestants"]}
    for verdict in session.scalars(select(VerdictRow).filter_by(league=league).order_by(VerdictRow.opened_at)):
        if not dependents.played.isdisjoint(verdict.schedules):
            dependents.verdicts.append(verdict.id)
            dependents.schedules |= set(verdict.schedules)
    dependents.played -= dependents.schedules
    matches = _count_matches(session, _matches_of(ref, dependents))
    children = session.scalars(_ready(league).filter_by(parent=number)).all()
    exploiters = session.scalars(_ready(league).filter_by(exploits=ref)).all()
    uses = or_(RunRow.parent == number, RunRow.exploits == ref)
    started = session.scalars(select(RunRow.id).filter_by(league=league).where(uses).order_by(RunRow.id)).all()
    nights = session.scalars(select(NightlyRunRow).filter_by(league=league, ended_at=None)).all()
    setting = traffic.current_setting(session, league)
    portions = {"canary": setting.canary, "shadow": setting.shadow}
    names = {number, *dependents.aliases}
    dependents.portions = [name for name, portion in portions.items() if portion and portion.version in names]
    dependents.reasons = [
        *(f"the alias {name} points to it" for name in dependents.aliases),
        *(f"it is the {name}" for name in dependents.portions),
        *(f"it is a part of the {role} @{user}" for user, role in _users_of(session, league, number).items()),
        *_counted(len(dependents.verdicts), "verdict", map(short_verdict, dependents.verdicts)),
        *_counted(matches, "recorded match", plural="recorded matches"),
        *(f"nightly run {night.id} tests it" for night in nights if number in night.candidates),
        *_counted(len(children), "version trained from it", _refs(children), "versions trained from it"),
        *_counted(len(exploiters), "exploiter of it", _refs(exploiters), "exploiters of it"),
        *_counted(len(started), "training run that uses it", started, "training runs that use it"),
    ]
    return dependents


def _delete_dependents(session: Session, league: str, number: int, found: _Dependents, actor: str) -> None:
    """Delete what depends on a version, and abandon it. Children and runs keep their weights and lose their parent."""
    change_counter.count(session, "aliases")
    change_counter.count(session, "leagues")
    if found.portions:
        change_counter.count(session, "traffic")
        traffic.end(session, league, found.portions, actor=actor, reason=f"{league}@{number} was removed")
    gone = set(session.scalars(select(AliasEvent.id).filter_by(league=league, version=number)))
    session.execute(delete(IdempotentCallTable).where(IdempotentCallTable.event.in_(gone)))
    session.execute(delete(AliasTable).filter_by(league=league, version=number))
    events = {event.id: event for event in session.scalars(select(AliasEvent).filter_by(league=league))}
    for event in events.values():  # a rollback returns to the event beneath those that are deleted
        while event.beneath is not None and event.beneath in gone:
            event.beneath = events[event.beneath].beneath
    session.flush()
    ref, strength, counts, schedule = f"{league}@{number}", StrengthRow, ShadowCounts, ScheduleTable
    sums = (ScheduleTotalTable, PairSumTable, GameDigestTable)
    of_results: tuple[Executable, ...] = (
        delete(AliasEvent).where(AliasEvent.id.in_(gone)),
        update(AliasEvent).where(AliasEvent.verdict.in_(found.verdicts)).values(verdict=None),
        delete(VerdictRow).where(VerdictRow.id.in_(found.verdicts)),
        delete(MatchTable).where(_matches_of(ref, found)),
        *(delete(table).where(table.schedule.in_(found.schedules)) for table in sums),
    )
    of_version: tuple[Executable, ...] = (
        delete(schedule).where(schedule.id.in_(found.schedules)),
        delete(schedule).where(schedule.id.in_(found.played), ~exists().where(MatchTable.schedule == schedule.id)),
        delete(SnapshotRow).filter_by(league=league),
        delete(VersionNoteTable).filter_by(league=league, version=number),
        delete(strength).where(strength.league == league, or_(strength.version == number, strength.opponent == ref)),
        delete(counts).where(counts.league == league, or_(counts.candidate == number, counts.champion == number)),
        update(VersionTable).filter_by(league=league, parent=number).values(parent=None),
        update(RunRow).filter_by(league=league, parent=number).values(parent=None),
        update(VersionTable).filter_by(league=league, number=number).values(state=ABANDONED),
    )
    for statement in of_results:
        session.execute(statement)
    for name in found.played:
        _delete_sums(session, name, ref)
    for statement in of_version:
        session.execute(statement)


def _delete_sums(session: Session, schedule: str, ref: str) -> None:
    """Delete the sums over the deleted matches of a version in a schedule, which is deleted if it has no others."""
    pair, match, total = PairSumTable, MatchTable, ScheduleTotalTable
    of_version = or_(pair.first == ref, pair.second == ref)
    session.execute(delete(pair).where(pair.schedule == schedule, of_version))
    recorded = select(match.position, func.length(match.moves)).where(match.schedule == schedule)
    sizes: dict[int, int] = dict(session.execute(recorded).tuples().all())
    for row in session.scalars(select(GameDigestTable).filter_by(schedule=schedule)):
        begin = STRIPE * row.stripe
        positions = [position for position in range(begin, begin + STRIPE) if position in sizes]
        if not positions:
            session.delete(row)
            continue
        kept = bytearray(DIGEST_BYTES * (positions[-1] + 1 - begin))
        for start in (DIGEST_BYTES * (position - begin) for position in positions):
            kept[start : start + DIGEST_BYTES] = row.digests[start : start + DIGEST_BYTES]
        row.digests = bytes(kept)
    session.flush()
    row_of_total = session.get_one(total, schedule)
    row_of_total.matches, row_of_total.size = len(sizes), sum(sizes.values())
    if not sizes:
        session.delete(row_of_total)
    session.flush()


def _matches_of(ref: str, found: _Dependents) -> ColumnElement[bool]:
    """Matches of deleted schedules, and those of other schedules in which the version takes part."""
    takes_part = or_(MatchTable.first == ref, MatchTable.second == ref)
    return or_(MatchTable.schedule.in_(found.schedules), and_(MatchTable.schedule.in_(found.played), takes_part))


def _require_idle(session: Session, league: str) -> None:
    """Raise Conflict while the league is trained or evaluated."""
    for run in runs.active(session, league):
        if run.state == runs.RUNNING:
            raise Conflict(f"training run {run.id} of league {league} is active: stop it first, or wait for its end")
    for evaluation in evaluations.active(session, league):
        raise Conflict(f"evaluation {evaluation.id} of league {league} is {evaluation.state}: stop it, or wait")


def _users_of(session: Session, league: str, number: int) -> dict[int, str]:
    """Return the mixtures and search versions that a version plays for, with their roles, ascending."""
    users = _ready(league).where(VersionTable.role.in_((MIXTURE, SEARCH)))
    return {
        user.number: user.role
        for user in session.scalars(users)
        if number in versions.members(session, league, [user.number])
    }


def _require_free(target: str, reasons: Sequence[str], force: bool) -> None:
    if reasons and not force:
        raise Conflict(
            f"{target} is in use: {'; '.join(reasons)}. --force removes it with everything that depends on it"
        )


def _ready(league: str) -> Select[VersionTable]:
    return select(VersionTable).filter_by(league=league, state=READY).order_by(VersionTable.number)


def _refs(rows: Iterable[VersionTable]) -> list[str]:
    return [f"@{row.number}" for row in rows]


def _names(session: Session, column: InstrumentedAttribute[str], league: str) -> tuple[str, ...]:
    return tuple(session.scalars(select(column).where(column.class_.league == league).order_by(column)))


def _count_matches(session: Session, which: ColumnElement[bool]) -> int:
    return session.scalar(select(func.count()).select_from(MatchTable).where(which)) or 0


def _counted(count: int, what: str, names: Iterable[str] = (), plural: str | None = None) -> Iterator[str]:
    """`2 verdicts (0f3a62d1, 77c01d2e)`, or nothing."""
    if count:
        first = list(islice(names, MAX_NAMED))
        more = [f"{count - MAX_NAMED} more"] if first and count > MAX_NAMED else []
        listed = f" ({', '.join(first + more)})" if first else ""
        yield f"{count:,} {what if count == 1 else plural or f'{what}s'}{listed}"
