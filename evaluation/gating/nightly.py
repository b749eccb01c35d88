"""The nightly run of a league: tests new versions, promotes those that pass, and updates the ratings.

Every step is stored in the registry or the ledger before the next begins. An interrupted run resumes without playing a
match twice, repeating a verdict, or losing or repeating a promotion.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from evaluation.documents import Document, Progress, Standing
from evaluation.gating import verdicts
from evaluation.gating.criteria.criterion import Contest
from evaluation.gating.evidence import Confirmation, VerdictReport, confirmation
from evaluation.gating.former_champions import rolled_back
from evaluation.gating.trained_exploiters import Trainer, check_exploiters
from evaluation.matches import tournament
from evaluation.matches.leaderboard import compute_leaderboard
from evaluation.matches.tournament import fixed_baselines
from evaluation.schedules.builders import ANCHOR, gauntlet
from evaluation.statistics.alpha_spending import alpha_share, alpha_spent
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import (
    ArtifactCorrupt,
    BoundExceeded,
    EnvironmentMismatch,
    ExploiterMissing,
    FilesMissing,
    GameCrashed,
    GameHung,
    GraphTimeout,
    InvalidInput,
    NotFound,
    ObservationError,
    RemoteError,
    WorkerLost,
)
from league.policies.loading import check_contestants, eligible
from league.ray_cluster import ray_session
from league.refs import CHAMPION, CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.manifest import SearchSettings
from league.registry.storage.rows import LeagueRow, NightlyRunRow, VerdictRow, VersionRow
from league.results.ledger import Ledger
from league.search.policies import publish_search

RATING_BLOCKS = 32
"""Matches of a new version against each opponent for its rating, in addition to those of its verdict."""

CONTESTANT_FAULTS = (
    ArtifactCorrupt,
    BoundExceeded,
    EnvironmentMismatch,
    ExploiterMissing,
    GameCrashed,
    GameHung,
    GraphTimeout,
    NotFound,
    ObservationError,
    RemoteError,
    WorkerLost,
)
"""Errors of a single version, which do not prevent verdicts on the others."""

NightlyListener = Callable[[Progress | VerdictReport], None]
"""Receives progress and verdicts, in the process that started the nightly run."""


@dataclass(frozen=True, slots=True)
class NightlyReport(Document):
    """A nightly run: its verdicts in order, the champion before and after, and all ratings.

    confirmations: confirmation matches played in this run.
    alpha_spent: by all verdicts of the last 365 days, of the gate's `alpha`.
    faults: versions that could not be gated or rated, with the reasons; they are retried in the next run.
    leaderboard: at the end of the gate, without `unique_games`.
    """

    league: str
    champion_before: str | None
    champion: str | None
    verdicts: tuple[VerdictReport, ...]
    confirmations: tuple[Confirmation, ...]
    alpha_spent: float
    faults: tuple[str, ...]
    leaderboard: tuple[Standing, ...]
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """The document, with the verdicts as they are stored."""
        return Document.to_json(self) | {"verdicts": [verdict.to_record() for verdict in self.verdicts]}


def nightly(
    config: LeagueConfig,
    *,
    registry: Registry,
    train: Trainer | None = None,
    workers: int | None = 0,
    listener: NightlyListener | None = None,
) -> NightlyReport:
    """Gate all versions without a verdict, oldest first, each against the current champion.

    Without a champion, the opponent is `script:random`. If the champion is a search version, a version with a value
    graph is tested with the same search, for which a search version is published. Each new version then plays a short
    gauntlet for its rating. A version that cannot play is reported as a fault.

    Args:
        config: Configuration of the league.
        registry: Registry of the league.
        train: Trains the exploiters that `gate.exploiters` requires. Without it, verdicts that need them stay open.
        workers: Parallel Ray tasks, as in `play_schedule`.
        listener: Receives progress and verdicts.

    Raises:
        ConfigError: A script, a bot or an anchor of the configuration does not exist or cannot play, or the gate asks
            for less exploitability in a league with one side.
        AlreadyRunning: Another nightly run of this league is active.
        LeagueArchived: The league is archived.
        InterfaceChanged: The configuration no longer fits the league's versions.
        WorkerLost: Workers died repeatedly.
    """
    began = time.monotonic()
    with registry.exclusive_lock(f"nightly-{config.league}"), ray_session():
        league_interface = interface(config)
        check_contestants(config, league_interface, registry)
        check_exploiters(config, league_interface)
        registry.leagues.register(config, league_interface)
        nightly_run = _NightlyRun(registry, registry.leagues.get(config.league), train, workers, listener)
        nightly_run.find_missing_files()
        before = nightly_run.champion()
        nightly_run.run_gate()
        nightly_run.confirm()
        nightly_run.rate()
        report = NightlyReport(
            league=config.league,
            champion_before=before,
            champion=nightly_run.champion(),
            verdicts=tuple(nightly_run.verdicts),
            confirmations=tuple(nightly_run.confirmations),
            alpha_spent=nightly_run.spent(),
            faults=tuple(nightly_run.faults),
            leaderboard=compute_leaderboard(registry, config.league),
            seconds=time.monotonic() - began,
        )
        nightly_run.close(report)
        return report


class _NightlyRun:
    def __init__(
        self,
        registry: Registry,
        league: LeagueRow,
        train: Trainer | None,
        workers: int | None,
        listener: NightlyListener | None,
    ) -> None:
        self._registry, self._league, self._train = registry, league, train
        self._workers, self._listener = workers, listener
        self._row: NightlyRunRow | None = None
        self.verdicts: list[VerdictReport] = []
        self.confirmations: list[Confirmation] = []
        self.faults: list[str] = []

    def champion(self) -> str | None:
        number = self._registry.aliases.current(self._league.slug).get(CHAMPION)
        return None if number is None else f"{self._league.slug}@{number}"

    def spent(self) -> float:
        """The α of a year spent by all verdicts of nightly runs."""
        rows = self._registry.verdicts.all(self._league.slug)
        return alpha_spent(((row.opened_at, row.alpha) for row in rows if row.settings.get("night")), datetime.now(UTC))

    def run_gate(self) -> None:
        """Finish the open verdicts, then gate every version without one."""
        for row in self._registry.verdicts.all(self._league.slug):
            if row.outcome is None:
                self._conclude(row)
        nightly_runs = self._registry.nightly_runs.all(self._league.slug)
        self._row = next((row for row in nightly_runs if row.ended_at is None), None)
        if self._row is not None:
            self._test_candidates(self._row)
        if waiting := self._waiting():
            if self._row is not None:
                self._registry.nightly_runs.close(self._row.id, None)
            self._row = self._begin(waiting)
            if self._row is not None:
                self._test_candidates(self._row)

    def _waiting(self) -> list[int]:
        """Versions that the current nightly run does not include."""
        untested = self._untested()
        return [version.number for version in untested if self._row is None or not self._includes(self._row, version)]

    def _begin(self, candidates: list[int]) -> NightlyRunRow | None:
        """Open a nightly run. None if the α of the year is spent."""
        gate = self._league.config.gate
        alpha = (
            gate.alpha if gate.nights is None else alpha_share(len(candidates), gate.alpha, gate.nights, self.spent())
        )
        if alpha > 0:
            return self._registry.nightly_runs.open(self._league.slug, candidates, alpha)
        self.faults.append(
            f"versions are waiting ({len(candidates)}): the verdicts of the last 365 days spent all of gate.alpha"
            f" ({gate.alpha:g}); for more than {gate.nights} nightly runs per year, raise gate.nights"
        )
        return None

    def find_missing_files(self) -> None:
        """Report versions whose files were deleted: they may be needed by no match of this run."""
        for version in self._registry.versions.all(self._league.slug):
            if version.retired_at is None:
                try:
                    self._registry.artifacts.check_exists(version.league, version.number)
                except FilesMissing as error:
                    self.faults.append(str(error))

    def _test_candidates(self, nightly_run: NightlyRunRow) -> None:
        league = self._league
        # Without a limit of nightly runs, verdicts do not count against the α of a year.
        number = None if league.config.gate.nights is None else nightly_run.id
        for version in self._untested():
            if self._includes(nightly_run, version):
                with self._faults_of(version.ref):
                    opponent, alpha = self.champion() or ANCHOR, nightly_run.alpha
                    candidate = self._with_the_search_of_the_champion(version).number
                    self._conclude(verdicts.open_verdict(self._registry, league, candidate, opponent, alpha, number))

    def confirm(self) -> None:
        """Play the missing confirmation matches of promotions."""
        for row in self._registry.verdicts.all(self._league.slug):
            if row.outcome == "promote" and confirmation(Contest.of(self._registry, row)) is None:
                with self._faults_of(f"the confirmation of {row.league}@{row.candidate}"):
                    gain = verdicts.confirm(self._registry, row, workers=self._workers, listener=self._listener)
                    if gain is not None:
                        self.confirmations.append(gain)

    def close(self, report: NightlyReport) -> None:
        if self._row is not None:
            self._registry.nightly_runs.close(self._row.id, report.to_json())

    def rate(self) -> None:
        """Play the missing or unfinished rating gauntlet of each version."""
        ledger, league = Ledger(self._registry), self._league
        gauntlets = {
            schedule.contestants[0]: schedule
            for schedule in ledger.schedules(league.slug)
            if schedule.kind == "gauntlet" and schedule.conditions == league.conditions
        }
        versions = eligible(self._registry, league.slug)
        refs = {version.ref for version in versions}
        for previous, version in zip([None, *versions], versions, strict=False):
            if (schedule := gauntlets.get(version.ref)) is None:
                rivals = (self.champion(), None if previous is None else previous.ref)
                opponents = fixed_baselines(self._registry, league)
                opponents += [ref for ref in rivals if ref is not None and ref in refs - {version.ref}]
                schedule = gauntlet(
                    league.config, league.interface, [version.ref], list(dict.fromkeys(opponents)), RATING_BLOCKS
                )
            if len(ledger.positions(schedule.id)) < schedule.length:
                with self._faults_of(version.ref):
                    tournament.play_schedule(
                        schedule, registry=self._registry, workers=self._workers, listener=self._listener
                    )

    def _untested(self) -> list[VersionRow]:
        """Versions without an effective verdict that are not champion and were not rolled back, oldest first.

        Those that exist with the search of the champion are candidates only with it, and in the order without it.
        Those that were tested with the search of an earlier champion are tested.
        """
        league, champion = self._league.slug, self.champion()
        former = rolled_back(self._registry.aliases.history(league))
        versions = self._registry.versions.all(league)
        searches = {version.ref: version.search for version in versions if version.search is not None}
        tested: set[int] = set()
        for row in self._registry.verdicts.all(league):
            if verdicts.is_effective(row):
                tested.add(row.candidate)
                search, opponent = searches.get(f"{league}@{row.candidate}"), searches.get(row.champion)
                if search is not None and opponent is not None and _are_alike(search, opponent):
                    tested.add(search.version)
        searched = {self._number_without_search(version) for version in versions if version.retired_at is None}
        excluded = former | tested | searched
        untested = [
            version
            for version in eligible(self._registry, league)
            if version.ref != champion and version.number not in excluded
        ]
        return sorted(untested, key=lambda version: self._number_without_search(version) or version.number)

    def _champions_search(self) -> SearchSettings | None:
        champion = self.champion()
        return None if champion is None else self._registry.versions.resolve(CheckpointRef.parse(champion)).search

    def _with_the_search_of_the_champion(self, version: VersionRow) -> VersionRow:
        """What is tested in place of a version."""
        search, league = self._champions_search(), self._league
        if search is None:
            return version
        try:
            searching = publish_search(
                self._registry, version, league.config.environment, league.interface, search.rule, search.simulations
            )
        except InvalidInput:  # it has no value graph, or searches itself
            return version
        return version if searching.retired_at is not None else searching

    def _number_without_search(self, version: VersionRow) -> int | None:
        """The version that this one plays with a search like that of the champion; None for others."""
        search, champions = version.search, self._champions_search()
        if search is None or champions is None or not _are_alike(search, champions):
            return None
        return search.version

    def _includes(self, nightly_run: NightlyRunRow, version: VersionRow) -> bool:
        return not {version.number, self._number_without_search(version)}.isdisjoint(nightly_run.candidates)

    def _conclude(self, verdict: VerdictRow) -> None:
        with self._faults_of(f"{verdict.league}@{verdict.candidate} against {verdict.champion}"):
            report = verdicts.conclude(
                self._registry, verdict, train=self._train, workers=self._workers, listener=self._listener
            )
            self.verdicts.append(report)
            if self._listener:
                self._listener(report)

    @contextmanager
    def _faults_of(self, who: str) -> Iterator[None]:
        try:
            yield
        except CONTESTANT_FAULTS as error:
            if str(error) not in self.faults:  # that all its files are missing
                self.faults.append(f"{who}: {error}")


def _are_alike(first: SearchSettings, second: SearchSettings) -> bool:
    """Whether two searches differ only in the version that they search with."""
    return (first.rule, first.simulations) == (second.rule, second.simulations)
