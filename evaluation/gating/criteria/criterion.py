"""What the tests of a verdict have in common: the contest, the record, the comparison with the champion, wording."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Self

from evaluation.gating.gate import Decision, SequentialTest, decide_matches
from evaluation.gating.gate_result import CriterionReport, CriterionResult
from evaluation.gating.trained_exploiters import Trainer
from evaluation.statistics.payoff import student_interval
from league.config.gate import GateConfig
from league.refs import CheckpointRef, parse_ref
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow, VerdictRow
from league.results.ledger import Ledger
from league.results.records import Match, Schedule


@dataclass(frozen=True, slots=True)
class Contest:
    """Who is tested, against whom, and with which settings.

    Attributes:
        registry: The registry of the verdict.
        ledger: The ledger of the registry.
        verdict: The verdict.
        schedule: Its own schedule, of the candidate against the champion.
        gate: Its settings.
        candidate: Reference of its candidate.
        champion: Reference of the champion, or of the script that is the opponent without a champion.
        title: `the champion`, or the script.
    """

    registry: Registry
    ledger: Ledger
    verdict: VerdictRow
    schedule: Schedule
    gate: GateConfig
    candidate: str
    champion: str
    title: str

    @classmethod
    def of(cls, registry: Registry, verdict: VerdictRow) -> Self:
        """The contest of a verdict."""
        ledger, champion = Ledger(registry), verdict.champion
        title = "the champion" if isinstance(parse_ref(champion), CheckpointRef) else champion
        schedule = ledger.schedule(verdict.id)
        return cls(registry, ledger, verdict, schedule, verdict.gate, verdict.candidate_ref, champion, title)


@dataclass(frozen=True, slots=True, kw_only=True)
class Criterion(ABC):
    """A test that a candidate must pass, as the settings of its verdict record it.

    Attributes:
        schedule: Id of the schedule of its matches; None while its opponents are not trained.
    """

    kind: ClassVar[str]
    """Kind of its schedule, and of its record."""

    schedule: str | None

    @classmethod
    @abstractmethod
    def planned(
        cls, registry: Registry, league: LeagueRow, verdict: Schedule, gate: GateConfig
    ) -> list[tuple[Self, Schedule | None]]:
        """Choose the tests of this kind in a new verdict.

        Args:
            registry: The registry of the league.
            league: The league.
            verdict: Schedule of the candidate against the champion.
            gate: Settings of the verdict.

        Returns:
            Each test with the schedule of its matches, None if its opponents are still to be trained.
        """

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Self:
        """Read a test from its record. The inverse of `to_record`."""
        fields: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in record.items() if name != "kind"
        }
        return cls(**fields)

    def to_record(self) -> dict[str, Any]:
        """Return the record in the settings of a verdict, in the types of JSON."""
        return {"kind": self.kind} | {
            name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()
        }

    def prepared(self, contest: Contest, train: Trainer | None) -> Self | None:  # noqa: ARG002
        """Train the opponents that do not exist yet, and return the test with its schedule.

        Args:
            contest: That of an open verdict.
            train: Trains a run; None where nothing can be trained.

        Returns:
            The test as the verdict records it, or None if the verdict is closed meanwhile.
        """
        return self

    @abstractmethod
    def sequential(self, contest: Contest) -> SequentialTest:
        """How the test is decided."""

    @abstractmethod
    def result(self, contest: Contest, matches: Sequence[Match]) -> CriterionResult:
        """Decide the test. matches: those of its schedule, in order."""


def paired_result(
    test: Criterion,
    contest: Contest,
    matches: Sequence[Match],
    *,
    ref: str,
    opponent: str,
    margin: float,
    setting: str,
    report: Callable[..., CriterionReport],
) -> CriterionResult:
    """Decide a test in which candidate and champion each play blocks against one opponent.

    Args:
        test: The test.
        contest: The contest.
        matches: Those of the test's schedule, in order.
        ref: The opponent.
        opponent: What it is: `connect_four@7, an exploiter of connect_four@5`.
        margin: By how much the candidate may be worse.
        setting: The setting of the margin: `gate.exploiter_margin`.
        report: Creates the report from its fields.
    """
    gate, champion = contest.gate, contest.champion
    decision = decide_matches(test.sequential(contest), matches)
    unit, worse, setting = (
        margin_unit(gate.model),
        f"worse than {contest.title} against {opponent}",
        f"{setting}: {margin:g}",
    )
    bar = f"it may do at most about {margin / 2:g} {unit} worse against {ref} than {champion}"
    score = champion_score = difference = scores = None
    if decision.blocks and decision.observations:
        score, champion_score = decision.observations.means
        difference = student_interval(decision.observations.gaps)
        least = max(champion_score - margin / 2, 0)
        scores = f"Against {ref} it scored {percent(score, least)}, and {champion} {percent(champion_score, least)}."
        if gate.model != "returns":
            bar = f"it must score more than about {percent(least, score, champion_score)} against {ref}"
    outcome, finding = worded(decision, "not worse", "worse", f"than {champion} by {margin:g} {unit}", champion)
    return CriterionResult(
        decision=decision,
        report=report(
            **statistics(decision),
            ref=ref,
            margin=margin,
            schedule=test.schedule,
            outcome=outcome,
            finding=f"against {ref} {finding}",
            score=score,
            champion_score=champion_score,
            difference=difference,
        ),
        passed=f"is at most {margin:g} {worse}",
        failed=f"does {worse}",
        scores=scores,
        requirement=f"To pass, {bar} ({setting}).",
        wider=f"a larger {setting}",
    )


def statistics(decision: Decision) -> dict[str, Any]:
    """The fields of a report that describe a sequential test."""
    return {
        "llr": decision.llr,
        "bounds": decision.bounds,
        "blocks": decision.blocks,
        "games": decision.games,
        "unique_games": decision.unique_games or 0,
        "counts": decision.counts,
    }


def elo_statistics(decision: Decision) -> dict[str, Any]:
    """The fields of a report that compare the candidate with one opponent."""
    estimate = decision.estimate
    return {
        "score": decision.score,
        "elo": estimate and estimate.elo,
        "interval": estimate and estimate.interval,
    }


def percent(share: float, *beside: float | None) -> str:
    """`75.9 %`, with as many decimals, up to four, as tell it from the shares that it is compared with."""
    shares = {value for value in (share, *beside) if value is not None}
    distinct = (n for n in range(1, 4) if len({f"{100 * value:.{n}f}" for value in shares}) == len(shares))
    return f"{100 * share:.{next(distinct, 4)}f} %"


def margin_unit(model: str) -> str:
    """The unit of the margins of comparisons with the champion. model: of the gate."""
    return "in returns" if model == "returns" else "of all points"


def worded(decision: Decision, passed: str, failed: str, comparison: str, other: str) -> tuple[str, str]:
    """The outcome of a test, and what it found: `not worse than connect_four@1 by 0.1 of all points after 600 games`.

    An undecided test shows nothing about the margin: `inconclusive compared with connect_four@1 after 600 games`.

    Args:
        decision: The decision.
        passed: The outcome of a passed test.
        failed: The outcome of a failed test.
        comparison: What follows a decided outcome.
        other: With whom the candidate is compared.
    """
    outcomes = {"promote": passed, "reject": failed, "inconclusive": "inconclusive", None: "open"}
    outcome = outcomes[decision.outcome]
    if decision.outcome not in ("promote", "reject"):
        comparison = f"compared with {other}"
    return outcome, f"{outcome} {comparison} after {decision.games} games"
