"""The face of the registry: each method is one transaction, or a version's whole way to being published."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

from league.config import LeagueConfig
from league.errors import StorageError
from league.interface import Interface
from league.refs import CHAMPION, CheckpointRef
from league.registry import (
    acknowledgements,
    aliases,
    evaluations,
    exclusion,
    keys,
    leagues,
    nights,
    notes,
    publishing,
    pulse,
    reports,
    runs,
    shadows,
    snapshots,
    traffic,
    verdicts,
    versions,
)
from league.registry.aliases import AnyVersion
from league.registry.artifacts import ArtifactStore
from league.registry.database import Database
from league.registry.faults import DISK_FULL_OR_SHUT, disk_faults
from league.registry.idempotency import Call, once
from league.registry.manifest import Manifest
from league.registry.rows import (
    Acknowledgement,
    AliasEvent,
    EvaluationRow,
    EvaluationState,
    KeyRow,
    LeagueRow,
    NightRow,
    Portion,
    Pulse,
    RunPoint,
    RunRow,
    RunState,
    Shadowing,
    SnapshotRow,
    Traffic,
    VerdictRow,
    VersionRow,
)
from league.registry.traffic import KEEP, Unchanged
from league.settings import Storage

Build = Callable[[Path, int], Manifest]
"""Writes the files of version `number` into a directory and returns its manifest, without digests."""


class Registry:
    """Leagues, versions, aliases, verdicts, evaluations, training runs … May be used by several threads.

    Every method raises StorageError, in one sentence, when the database or the artefact store fails.
    """

    def __init__(self, storage: Storage, database: Database) -> None:
        self.storage = storage
        self.database = database
        self.artifacts = ArtifactStore(storage.artifacts)

    @classmethod
    def open(cls, storage: Storage | None = None, create: bool = True) -> Self:
        """The registry at `storage`, by default that of the environment; made (if `create`) or migrated if need be."""
        storage = storage or Storage.from_environment()
        return cls(storage, Database(storage.database_url, create))

    def close(self) -> None:
        """Give the connections back."""
        self.database.close()

    # Leagues

    def register(self, config: LeagueConfig, interface: Interface) -> None:
        """Make a league known or renew its configuration. Raises InterfaceChanged if versions differ."""
        with self.database.write() as session:
            leagues.register(session, config, interface)

    def leagues(self) -> list[LeagueRow]:
        """All leagues by name."""
        with self.database.read() as session:
            return leagues.every(session)

    def league(self, slug: str) -> LeagueRow:
        """One league. Raises UnknownLeague."""
        with self.database.read() as session:
            return leagues.get(session, slug)

    def pulse(self, league: str, since: timedelta = timedelta(seconds=15)) -> Pulse:
        """Where a league stands: another, if anything of it is. Raises UnknownLeague.

        since: for how long a replica that serves it may have been silent.
        """
        with self.database.read() as session:
            return pulse.take(session, league, since)

    # Versions

    def publish(self, league: str, build: Build, *, source: str, parent: int | None = None) -> VersionRow:
        """Publish what `build` writes as the next version, whole or not at all.

        source: names the checkpoint; publishing it again returns the version that it became.
        Raises UnknownLeague, UnknownVersion (of the parent), InterfaceChanged, and whatever `build` raises.
        """
        self.sweep(league)
        with self.database.write() as session:
            leagues.lock(session, league)
            if (ready := versions.of_source(session, league, source)) is None:
                number = publishing.reserve(session, league, source, parent, above=self.artifacts.last(league))
        if ready is None:
            ready = self._build(league, number, build, source, parent)
        return self.version(league, ready)

    def sweep(self, league: str) -> None:
        """Clear away what publishers that died have left."""
        with self.database.write() as session:
            numbers = publishing.stale(session, league)
        for number in numbers:
            self._clear(league, number)

    def versions(self, league: str) -> list[VersionRow]:
        """All versions of a league, ascending. Raises UnknownLeague."""
        with self.database.read() as session:
            return versions.every(session, league)

    def newest_versions(self, league: str, *, before: int | None = None, limit: int = 20) -> list[VersionRow]:
        """A league's versions, newest first, of those with a lower number than `before`. Raises UnknownLeague."""
        with self.database.read() as session:
            return versions.newest(session, league, before, limit)

    def version_numbers(self, league: str | None = None) -> dict[str, list[int]]:
        """league → numbers of its versions, ascending: of one league or of all that have any."""
        with self.database.read() as session:
            return versions.numbers(session, league)

    def version(self, league: str, number: int) -> VersionRow:
        """One version. Raises UnknownLeague or UnknownVersion."""
        with self.database.read() as session:
            return versions.get(session, league, number)

    def note(self, ref: CheckpointRef, text: str, *, actor: str) -> VersionRow:
        """Write of a version what people shall know, in place of what was written before; empty: nothing any more.

        Raises UnknownLeague, UnknownVersion, UnknownAlias or InvalidInput.
        """
        with self.database.write() as session:
            version = versions.resolve(session, ref)
            notes.write(session, version.league, version.number, text, actor)
            return versions.get(session, version.league, version.number)

    def resolve(self, ref: CheckpointRef | str) -> VersionRow:
        """The version that a reference names now.

        Raises InvalidReference, UnknownLeague, UnknownVersion or UnknownAlias.
        """
        ref = CheckpointRef.parse(ref) if isinstance(ref, str) else ref
        with self.database.read() as session:
            return versions.resolve(session, ref)

    def fetch(self, league: str, number: int) -> Path:
        """A local directory with the files of a version, each verified. Raises ArtifactCorrupt."""
        return self.artifacts.verify(league, number, self.version(league, number).sha256)

    def _build(self, league: str, number: int, build: Build, source: str, parent: int | None) -> int:
        """Write a reserved version; returns the number of the one that is ready in the end."""
        try:
            staging = self.artifacts.stage(league, number)
            with disk_faults(staging, only=DISK_FULL_OR_SHUT):
                manifest = build(staging, number)
            publishing.check(manifest, league, number, parent)
            text = self.artifacts.commit(manifest)
            with self.database.write() as session:
                return publishing.finish(session, manifest, text, source)
        finally:
            self._withdraw_unfinished(league, number)

    def _withdraw_unfinished(self, league: str, number: int) -> None:
        """Leave nothing of a version that is not ready. What cannot be cleared away now is swept later."""
        with suppress(StorageError):
            with self.database.write() as session:
                abandoned = publishing.abandon(session, league, number)
            if abandoned:
                self._clear(league, number)

    def _clear(self, league: str, number: int) -> None:
        self.artifacts.discard(league, number)
        with self.database.write() as session:
            publishing.forget(session, league, number)

    # Aliases

    def aliases(self, league: str) -> dict[str, int]:
        """alias → version. Raises UnknownLeague."""
        with self.database.read() as session:
            return aliases.current(session, league)

    def all_aliases(self) -> dict[tuple[str, str], int]:
        """(league, alias) → version of all leagues, by one cheap query."""
        with self.database.read() as session:
            return aliases.every(session)

    def set_alias(
        self,
        league: str,
        alias: str,
        version: int,
        *,
        expected: int | AnyVersion | None,
        actor: str,
        reason: str,
        verdict: str | None = None,
        call: Call | None = None,
    ) -> AliasEvent:
        """Point `alias` at `version` if it points at `expected` (None: if it does not exist; ANY: always).

        Returns the event in force. A `call` that was applied before changes nothing and returns its event.
        Raises UnknownLeague, UnknownVersion, KeyReused, or AliasMoved, saying where it is.
        """
        with self.database.write() as session:
            return once(
                session,
                league,
                call,
                lambda: aliases.move(
                    session,
                    league,
                    alias,
                    version,
                    expected=expected,
                    actor=actor,
                    reason=reason,
                    verdict=verdict,
                ),
            )

    def rollback(self, league: str, *, actor: str, reason: str, call: Call | None = None) -> AliasEvent:
        """Return the champion to the one before it, unless `call` did so: then return its event.

        Raises UnknownLeague, NothingToRollBack or KeyReused.
        """
        with self.database.write() as session:
            return once(
                session, league, call, lambda: aliases.roll_back(session, league, CHAMPION, actor=actor, reason=reason)
            )

    def history(
        self,
        league: str,
        alias: str = CHAMPION,
        at: datetime | None = None,
        *,
        before: int | None = None,
        limit: int | None = None,
    ) -> list[AliasEvent]:
        """The events of an alias, newest first; with `at`, only the one that was in force then.

        before: those older than the event of this id. limit: so many at most. Raises UnknownLeague.
        """
        with self.database.read() as session:
            return aliases.history(session, league, alias, at, before, limit)

    # Acknowledgements

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
        """Say what a replica serves of a league, by which alias, and why not what it should. Raises UnknownLeague.

        traffic: the id of the setting that it follows.
        """
        with self.database.write() as session:
            acknowledgements.write(session, replica, league, version, sha256, fault, aliases, traffic)

    def acknowledgements(self, league: str, since: timedelta = timedelta(seconds=15)) -> list[Acknowledgement]:
        """What replicas said of a league in the last `since`. Raises UnknownLeague."""
        with self.database.read() as session:
            return acknowledgements.fresh(session, league, since)

    def replicas(self, since: timedelta = timedelta(seconds=15)) -> list[str]:
        """The replicas that live: that said anything in the last `since`."""
        with self.database.read() as session:
            return acknowledgements.replicas(session, since)

    def forget(self, replica: str) -> None:
        """Remove what a replica said: it stops."""
        with self.database.write() as session:
            acknowledgements.forget(session, replica)
            reports.forget(session, replica, acknowledgements.KEPT)

    # Traffic

    def set_traffic(
        self,
        league: str,
        *,
        canary: Portion | Unchanged | None = KEEP,
        shadow: Portion | Unchanged | None = KEEP,
        actor: str,
        reason: str,
        call: Call | None = None,
    ) -> Traffic:
        """Set where requests for a league's champion go besides; None ends a canary or shadow, KEEP leaves it.

        Returns the setting in force. A `call` that was applied before changes nothing and returns its setting.
        Raises UnknownLeague, UnknownVersion, UnknownAlias, InvalidInput or KeyReused.
        """
        with self.database.write() as session:
            return once(
                session,
                league,
                call,
                lambda: traffic.put(session, league, canary=canary, shadow=shadow, actor=actor, reason=reason),
            )

    def traffic(self, league: str) -> Traffic:
        """Where requests for a league's champion go besides. Raises UnknownLeague."""
        with self.database.read() as session:
            return traffic.current(session, league)

    def all_traffic(self) -> dict[str, Traffic]:
        """league → the same, of all leagues that have a setting, by one cheap query."""
        with self.database.read() as session:
            return traffic.every(session)

    def traffic_history(self, league: str) -> list[Traffic]:
        """All settings of a league's traffic, newest first. Raises UnknownLeague."""
        with self.database.read() as session:
            return traffic.history(session, league)

    def report(self, replica: str, document: dict[str, Any], shadowings: Iterable[Shadowing] = ()) -> None:
        """Write what a replica measures of itself, and what it has counted of shadows since it started."""
        with self.database.write() as session:
            reports.write(session, replica, document)
            shadows.write(session, replica, shadowings)

    def reports(self, since: timedelta = timedelta(seconds=15)) -> dict[str, dict[str, Any]]:
        """replica → what it measures of itself, of those that said so in the last `since`."""
        with self.database.read() as session:
            return reports.fresh(session, since)

    def shadowings(self, league: str) -> list[Shadowing]:
        """What all replicas ever counted of a league's shadows, by candidate and champion."""
        with self.database.read() as session:
            return shadows.merged(session, league)

    # API keys

    def create_key(
        self,
        name: str,
        scopes: Collection[str],
        *,
        only_leagues: Collection[str] = (),
        expires_at: datetime | None = None,
        rate: float | None = None,
    ) -> tuple[KeyRow, str]:
        """Make an API key; returns it with its text, which is kept nowhere.

        scopes: of `keys.SCOPES`. only_leagues: all if empty. rate: requests per second.
        Raises InvalidReference, InvalidInput, UnknownLeague or NameTaken.
        """
        with self.database.write() as session:
            return keys.create(session, name, scopes, only_leagues=only_leagues, expires_at=expires_at, rate=rate)

    def api_keys(self) -> list[KeyRow]:
        """All API keys that ever were, oldest first."""
        with self.database.read() as session:
            return keys.every(session)

    def revoke_key(self, name: str) -> KeyRow:
        """Make an API key void, by its name or id. Raises UnknownKey."""
        with self.database.write() as session:
            return keys.revoke(session, name)

    # Verdicts

    def open_verdict(
        self, league: str, candidate: int, champion: str, schedule: str, settings: dict[str, Any]
    ) -> VerdictRow:
        """Open the verdict that counts the matches of `schedule`, or find it. Its id is the schedule's."""
        with self.database.write() as session:
            return verdicts.start(session, league, candidate, champion, schedule, settings)

    def close_verdict(self, verdict: str, outcome: str, evidence: dict[str, Any]) -> None:
        """Record how a verdict came out; twice is once. Raises UnknownVerdict, or Conflict if it is another."""
        with self.database.write() as session:
            verdicts.close(session, verdict, outcome, evidence)

    def void_verdict(self, verdict: str, note: str) -> VerdictRow:
        """End a verdict for a reason beside its games, or take back one that has fallen.

        Its alpha is spent. A promotion that it led to stays. Raises UnknownVerdict or Conflict.
        """
        with self.database.write() as session:
            return verdicts.void(session, verdict, note)

    def verdict(self, verdict: str) -> VerdictRow:
        """A verdict by its id. Raises UnknownVerdict."""
        with self.database.read() as session:
            return verdicts.one(session, verdict)

    def verdicts(self, league: str) -> list[VerdictRow]:
        """All verdicts of a league in the order in which they were opened. Raises UnknownLeague."""
        with self.database.read() as session:
            return verdicts.every(session, league)

    def newest_verdicts(self, league: str, *, before: str | None = None, limit: int = 20) -> list[VerdictRow]:
        """A league's verdicts, newest first, of those opened before the verdict `before`.

        Raises UnknownLeague, or InvalidInput if `before` is none of them.
        """
        with self.database.read() as session:
            return verdicts.newest(session, league, before, limit)

    def verdict_reasons(self, league: str, verdicts: Collection[str]) -> dict[str, tuple[str, str]]:
        """verdict → its outcome and the reason for that, as last computed, of those for which that was."""
        with self.database.read() as session:
            return snapshots.reasons(session, league, verdicts)

    def last_verdicts(self) -> dict[str, VerdictRow]:
        """league → the verdict that was closed last, of the leagues that have one."""
        with self.database.read() as session:
            return verdicts.last_closed(session)

    # Nights

    @contextmanager
    def alone(self, name: str) -> Iterator[None]:
        """Only one process at a time, on any machine that shares the database. Raises AlreadyRunning or StorageError.

        The lock goes with the process, however that ends.
        """
        with exclusion.alone(self.database.engine, self.storage.home, name):
            yield

    def open_night(self, league: str, candidates: Collection[int], alpha: float) -> NightRow:
        """Open a night that judges `candidates`, or find the one that an earlier process left open."""
        with self.database.write() as session:
            return nights.start(session, league, candidates, alpha)

    def close_night(self, night: int, report: dict[str, Any] | None) -> None:
        """End a night and record what came of it; twice is once."""
        with self.database.write() as session:
            nights.close(session, night, report)

    def nights(self, league: str) -> list[NightRow]:
        """All nights of a league, oldest first. Raises UnknownLeague."""
        with self.database.read() as session:
            return nights.every(session, league)

    # Evaluations

    def ask_evaluation(
        self,
        league: str,
        asked: dict[str, Any],
        *,
        actor: str,
        key: str | None = None,
        reason: str | None = None,
        most: int,
        call: Call | None = None,
    ) -> EvaluationRow:
        """Queue an evaluation, unless `call` did so: then return what became of that.

        key: the id of the API key that asks. most: evaluations that may be queued or running, of all leagues.
        Raises UnknownLeague, TooManyEvaluations or KeyReused.
        """
        with self.database.write() as session:
            return once(
                session,
                league,
                call,
                lambda: evaluations.ask(session, league, asked, actor=actor, key=key, reason=reason, most=most),
            )

    def evaluation(self, league: str, number: int) -> EvaluationRow:
        """One evaluation. Raises UnknownLeague or UnknownEvaluation."""
        with self.database.read() as session:
            return evaluations.one(session, league, number)

    def evaluations(self, league: str, *, before: int | None = None, limit: int = 20) -> list[EvaluationRow]:
        """A league's evaluations, newest first, those older than number `before`. Raises UnknownLeague."""
        with self.database.read() as session:
            return evaluations.newest(session, league, before, limit)

    def evaluation_counts(self) -> dict[str, dict[str, int]]:
        """league → state → evaluations that are queued and running."""
        with self.database.read() as session:
            return evaluations.counts(session)

    def stop_evaluation(self, league: str, number: int, *, actor: str) -> EvaluationRow:
        """Ask for the end of an evaluation. Raises UnknownLeague or UnknownEvaluation."""
        with self.database.write() as session:
            return evaluations.stop(session, league, number, actor)

    def claim_evaluation(self, runner: str, workers: int) -> EvaluationRow | None:
        """Give the oldest evaluation that waits, or whose runner has died, to `runner`; None if there is none."""
        with self.database.read() as session:
            if not evaluations.wait(session):
                return None
        with self.database.write() as session:
            return evaluations.claim(session, runner, workers)

    def beat_evaluation(self, number: int, runner: str, progress: dict[str, Any] | None = None) -> EvaluationRow:
        """Say that a runner lives, and how far it is; returns the evaluation, which another may run by now."""
        with self.database.write() as session:
            return evaluations.beat(session, number, runner, progress)

    def finish_evaluation(
        self,
        number: int,
        runner: str,
        state: EvaluationState,
        *,
        progress: dict[str, Any] | None = None,
        result: dict[str, Any] | None = None,
        error: dict[str, str] | None = None,
    ) -> None:
        """Record how an evaluation ended, unless another runner has it."""
        with self.database.write() as session:
            evaluations.finish(session, number, runner, state, progress=progress, result=result, error=error)

    def release_evaluation(self, number: int, runner: str) -> None:
        """Say that a runner is gone: another may go on."""
        with self.database.write() as session:
            evaluations.release(session, number, runner)

    # Snapshots

    def snapshot(self, league: str, part: str) -> SnapshotRow | None:
        """A part of what pages show of a league; None if it was not computed yet. Raises UnknownLeague."""
        with self.database.read() as session:
            return snapshots.one(session, league, part)

    def snapshots(self, part: str) -> dict[str, SnapshotRow]:
        """league → the same part, of all leagues that have it."""
        with self.database.read() as session:
            return snapshots.of_part(session, part)

    def snapshot_marks(self, league: str) -> dict[str, str]:
        """part → the mark of what it was computed from, of all parts of a league."""
        with self.database.read() as session:
            return snapshots.computed_from(session, league)

    def put_snapshots(self, league: str, documents: Mapping[str, Any], mark: str) -> None:
        """Replace these parts of a league's, all or none. Raises UnknownLeague.

        mark: of what they were computed from.
        """
        with self.database.write() as session:
            snapshots.put(session, league, documents, mark)

    def marks(self) -> dict[str, str]:
        """league → a mark of all that its snapshots follow from, of all leagues: another one, if anything is new."""
        with self.database.read() as session:
            return snapshots.marks(session)

    def stale_snapshots(self) -> list[str]:
        """The leagues whose snapshots are not up to date, those that have waited longest first."""
        with self.database.read() as session:
            return snapshots.stale(session)

    # Training runs

    def begin_run(
        self,
        league: str,
        run: str,
        *,
        algorithm: str,
        settings: dict[str, Any],
        seed: int,
        target: int,
        parent: int | None = None,
        steps: int = 0,
    ) -> RunRow:
        """Record that a training run begins, or goes on: what it told beyond `steps` is forgotten.

        target: steps at which it ends. parent: the version that it trains on from. Raises UnknownLeague.
        """
        with self.database.write() as session:
            return runs.begin(
                session,
                league,
                run,
                algorithm=algorithm,
                settings=settings,
                seed=seed,
                target=target,
                parent=parent,
                steps=steps,
            )

    def record_point(self, league: str, run: str, point: RunPoint | None, seconds: float | None = None) -> None:
        """Say that a run's driver lives, and where its curves are by now, if that is new. Raises UnknownRun.

        seconds: of training so far.
        """
        with self.database.write() as session:
            runs.tell(session, league, run, point, seconds)

    def end_run(self, league: str, run: str, state: RunState, error: str | None = None) -> None:
        """Record how a run ended. Raises UnknownRun."""
        with self.database.write() as session:
            runs.end(session, league, run, state, error)

    def run(self, league: str, run: str) -> RunRow:
        """One training run. Raises UnknownLeague or UnknownRun."""
        with self.database.read() as session:
            return runs.one(session, league, run)

    def runs(self, league: str, *, before: str | None = None, limit: int = 20) -> list[RunRow]:
        """A league's training runs, newest first, of those that began before the run `before`.

        Raises UnknownLeague, or InvalidInput if `before` is none of them.
        """
        with self.database.read() as session:
            return runs.newest(session, league, before, limit)

    def run_counts(self) -> dict[str, int]:
        """league → training runs that are on, of the leagues that have any."""
        with self.database.read() as session:
            return runs.counts(session)

    def run_points(self, league: str, run: str) -> list[RunPoint]:
        """The points of a run's curves, by their steps: some hundred at most. Raises UnknownLeague or UnknownRun."""
        with self.database.read() as session:
            return runs.points(session, league, run)
