"""The one sequence of a league's night: new versions are judged, the best is promoted, everybody is rated.

Every step is in the registry or the ledger before the next begins, so that a night that was killed is started again and
goes on: no finished match is played twice, no verdict falls twice, no promotion is lost or repeated.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

from evaluation import tournament, verdicts
from evaluation.cluster import cluster
from evaluation.contestants import ANCHOR, baselines
from evaluation.report import Confirmation, Listener, NightReport, VerdictReport
from evaluation.schedule import gauntlet
from evaluation.spending import share, spent
from evaluation.standings import standings
from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import (
    ArtifactCorrupt,
    BoundExceeded,
    EnvironmentMismatch,
    GameCrashed,
    GameHung,
    NotFound,
    ObservationError,
    WorkerLost,
)
from league.policies.pinning import eligible
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.registry.rows import LeagueRow, NightRow, VerdictRow, VersionRow
from league.results.ledger import Ledger
from league.results.records import Schedule

RATING_BLOCKS = 32
"""Matches of a new version against each opponent that its rating is based on, besides its verdict's."""

CONTESTANT_FAULTS = (
    ArtifactCorrupt,
    BoundExceeded,
    EnvironmentMismatch,
    GameCrashed,
    GameHung,
    NotFound,
    ObservationError,
    WorkerLost,
)
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
    with registry.alone(f"nightly-{config.league}"), cluster():
        registry.register(config, interface(config))
        night = _Night(registry, registry.league(config.league), workers, listener)
        before = night.champion()
        night.judge()
        night.confirm()
        night.rate()
        report = NightReport(
            league=config.league,
            champion_before=before,
            champion=night.champion(),
            verdicts=tuple(night.verdicts),
            confirmations=tuple(night.confirmations),
            alpha_spent=night.spent(),
            faults=tuple(night.faults),
            standings=standings(registry, config.league),
            seconds=time.monotonic() - began,
        )
        night.close(report)
        return report


class _Night:
    def __init__(self, registry: Registry, league: LeagueRow, workers: int, listener: Listener | None) -> None:
        self._registry, self._league = registry, league
        self._workers, self._listener = workers, listener
        self._row: NightRow | None = None
        self.verdicts: list[VerdictReport] = []
        self.confirmations: list[Confirmation] = []
        self.faults: list[str] = []

    def champion(self) -> str | None:
        number = self._registry.aliases(self._league.slug).get(CHAMPION)
        return None if number is None else f"{self._league.slug}@{number}"

    def spent(self) -> float:
        """Of a year's alpha, by all verdicts of nights."""
        rows = self._registry.verdicts(self._league.slug)
        return spent(((row.opened_at, row.alpha) for row in rows if row.settings.get("night")), datetime.now(UTC))

    def judge(self) -> None:
        """Every verdict that an earlier night left open, then every version that has none."""
        for row in self._registry.verdicts(self._league.slug):
            if row.outcome is None:
                self._conclude(row)
        nights = self._registry.nights(self._league.slug)
        self._row = next((row for row in nights if row.ended_at is None), None)
        if self._row is not None:
            self._judge_candidates(self._row)
        if waiting := self._waiting():
            if self._row is not None:
                self._registry.close_night(self._row.id, None)
            self._row = self._begin(waiting)
            if self._row is not None:
                self._judge_candidates(self._row)

    def _waiting(self) -> list[int]:
        """Versions that the night under way does not judge."""
        numbers = [version.number for version in self._unjudged()]
        return [number for number in numbers if self._row is None or number not in self._row.candidates]

    def _begin(self, candidates: list[int]) -> NightRow | None:
        """A new night; None where nothing is left of a year's alpha."""
        gate = self._league.config.gate
        alpha = gate.alpha if gate.nights is None else share(len(candidates), gate.alpha, gate.nights, self.spent())
        if alpha > 0:
            return self._registry.open_night(self._league.slug, candidates, alpha)
        self.faults.append(
            f"{len(candidates)} versions wait: the verdicts of the last 365 days have spent all of gate.alpha"
            f" ({gate.alpha:g}); where more than {gate.nights} nights a year are held, gate.nights must say so"
        )
        return None

    def _judge_candidates(self, night: NightRow) -> None:
        for version in self._unjudged():
            if version.number in night.candidates:
                self._open_and_conclude(version, night)

    def _open_and_conclude(self, version: VersionRow, night: NightRow) -> None:
        with self._faults_of(version.ref):
            opponent = self.champion() or ANCHOR
            row = verdicts.open_verdict(
                self._registry, self._league, version.number, opponent, night.alpha, self._number_of(night)
            )
            self._conclude(row)

    def _number_of(self, night: NightRow) -> int | None:
        """None where verdicts spend nothing of a year's alpha."""
        return None if self._league.config.gate.nights is None else night.id

    def confirm(self) -> None:
        """The fresh match of each promotion that has not had its own."""
        for row in self._registry.verdicts(self._league.slug):
            if row.outcome == "promote" and verdicts.confirmation(self._registry, row) is None:
                with self._faults_of(f"the confirmation of {row.league}@{row.candidate}"):
                    gain = verdicts.confirm(self._registry, row, workers=self._workers, listener=self._listener)
                    if gain is not None:
                        self.confirmations.append(gain)

    def close(self, report: NightReport) -> None:
        if self._row is not None:
            self._registry.close_night(self._row.id, report.to_json())

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

    def _unjudged(self) -> list[VersionRow]:
        """Oldest first."""
        return [each for each in eligible(self._registry, self._league.slug) if not self._is_judged(each)]

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
