"""The one sequence of a league's night: new versions are judged, the best is promoted, everybody is rated.

Every step is in the registry or the ledger before the next begins, so that a night that was killed is started again and
goes on: no finished match is played twice, no verdict falls twice, no promotion is lost or repeated.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from filelock import FileLock, Timeout

from evaluation import tournament, verdicts
from evaluation.contestants import ANCHOR, baselines, eligible
from evaluation.report import Listener, NightReport, VerdictReport
from evaluation.schedule import gauntlet
from evaluation.standings import standings
from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import (
    AlreadyRunning,
    ArtifactCorrupt,
    EnvironmentMismatch,
    GameHung,
    IllegalAction,
    ObservationError,
    StorageError,
)
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.registry.rows import LeagueRow, VerdictRow, VersionRow
from league.results.ledger import Ledger
from league.results.records import Schedule
from league.settings import Storage

RATING_BLOCKS = 32
"""Matches of a new version against each opponent that its rating is based on, besides its verdict's."""

CONTESTANT_FAULTS = (ArtifactCorrupt, EnvironmentMismatch, GameHung, IllegalAction, ObservationError)
"""What is wrong with one version, and no reason to leave the others unjudged."""


def nightly(
    config: LeagueConfig, *, registry: Registry, workers: int = 0, listener: Listener | None = None
) -> NightReport:
    """Judge the versions that have had no verdict, oldest first, each against the champion of that moment.

    Without a champion the opponent is `script:random`. Then each new version plays a short gauntlet for its rating.
    workers: Ray tasks at once; 0 plays in this process.
    listener: told of progress and of each verdict as it falls.
    Raises AlreadyRunning while another night of this league runs, InterfaceChanged if the configuration no
    longer fits the league's versions, and WorkerLost. A version that cannot play is a fault in the report,
    not an error.
    """
    began = time.monotonic()
    with _alone(registry.storage, config.league), tournament.cluster():
        registry.register(config, interface(config))
        night = _Night(registry, registry.league(config.league), workers, listener)
        before = night.champion()
        night.judge()
        night.rate()
        return NightReport(
            league=config.league,
            champion_before=before,
            champion=night.champion(),
            verdicts=tuple(night.verdicts),
            faults=tuple(night.faults),
            standings=standings(registry, config.league),
            seconds=time.monotonic() - began,
        )


@contextmanager
def _alone(storage: Storage, league: str) -> Iterator[None]:
    """Keep a second night of the league out. The lock goes with the process, however that ends."""
    path = storage.home / "locks" / f"nightly-{league}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(path, timeout=0).acquire()
    except Timeout as error:
        raise AlreadyRunning(f"another `league nightly` is at work on {league} (it holds {path})") from error
    except OSError as error:
        raise StorageError(f"{path} cannot be locked: {error.strerror}") from error
    with lock:
        yield


class _Night:
    def __init__(self, registry: Registry, league: LeagueRow, workers: int, listener: Listener | None) -> None:
        self._registry, self._league = registry, league
        self._workers, self._listener = workers, listener
        self.verdicts: list[VerdictReport] = []
        self.faults: list[str] = []

    def champion(self) -> str | None:
        number = self._registry.aliases(self._league.slug).get(CHAMPION)
        return None if number is None else f"{self._league.slug}@{number}"

    def judge(self) -> None:
        """Every verdict that an earlier night left open, then every version that has none."""
        for row in self._registry.verdicts(self._league.slug):
            if row.outcome is None:
                self._conclude(row)
        for version in self._registry.versions(self._league.slug):
            if not self._is_judged(version):
                opponent = self.champion() or ANCHOR
                self._conclude(verdicts.open_verdict(self._registry, self._league, version.number, opponent))

    def rate(self) -> None:
        """A short gauntlet of each version that has not played its own to the end."""
        ledger = Ledger(self._registry)
        digest = self._league.environment_digest
        begun = {
            schedule.contestants[0]: schedule
            for schedule in ledger.schedules(self._league.slug)
            if schedule.kind == "gauntlet" and schedule.environment_digest == digest
        }
        versions = eligible(self._registry, self._league.slug)
        for previous, version in zip([None, *versions], versions, strict=False):
            schedule = begun.get(version.ref) or self._gauntlet(version, previous)
            if len(ledger.positions(schedule.id)) < schedule.length:
                with self._faults_of(version.ref):
                    tournament.run(schedule, registry=self._registry, workers=self._workers, listener=self._listener)

    def _is_judged(self, version: VersionRow) -> bool:
        """Whether it is champion, or has a verdict that stands: neither void nor refused its promotion."""
        if version.ref == self.champion():
            return True
        rows = (row for row in self._registry.verdicts(self._league.slug) if row.candidate == version.number)
        return any(verdicts.stands(row) for row in rows)

    def _conclude(self, verdict: VerdictRow) -> None:
        with self._faults_of(f"{verdict.league}@{verdict.candidate} against {verdict.champion}"):
            report = verdicts.conclude(self._registry, verdict, workers=self._workers, listener=self._listener)
            self.verdicts.append(report)
            if self._listener:
                self._listener(report)

    def _gauntlet(self, version: VersionRow, previous: VersionRow | None) -> Schedule:
        """Against the baselines, the champion, and the version before it."""
        versions = {each.ref for each in eligible(self._registry, self._league.slug)} - {version.ref}
        rivals = (self.champion(), previous.ref if previous else None)
        opponents = [*baselines(self._league.interface), *(ref for ref in rivals if ref and ref in versions)]
        return gauntlet(
            self._league.config, self._league.interface, [version.ref], list(dict.fromkeys(opponents)), RATING_BLOCKS
        )

    @contextmanager
    def _faults_of(self, who: str) -> Iterator[None]:
        try:
            yield
        except CONTESTANT_FAULTS as error:
            self.faults.append(f"{who}: {error}")
