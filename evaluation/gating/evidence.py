"""The record of a verdict, computed from the ledger: its tests, their statistics, the outcome and the reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from evaluation.documents import Difference, Document, Forfeits, iso_timestamp
from evaluation.gating.criteria.anchor import AnchorReport, AnchorTest
from evaluation.gating.criteria.champion import ChampionTest
from evaluation.gating.criteria.criterion import Contest, Criterion, elo_statistics, statistics
from evaluation.gating.criteria.exploitability import ExploitabilityReport, ExploitabilityTest
from evaluation.gating.criteria.exploiter import ExploiterReport, ExploiterTest
from evaluation.gating.gate import cell_counts
from evaluation.gating.gate_result import CriterionReport, CriterionResult, GateResult
from evaluation.matches.game_records import forfeits, forfeits_of_all
from evaluation.statistics.payoff import paired_difference
from evaluation.statistics.sequential import elo_estimate
from league.registry.changes import OPEN
from league.registry.registry import Registry
from league.registry.storage.rows import VerdictRow
from league.results.records import Match

CRITERIA: tuple[type[Criterion], ...] = (ChampionTest, AnchorTest, ExploiterTest, ExploitabilityTest)
"""The kinds of tests, in the order in which they are played."""

LATER = ("opened_at", "closed_at", "hypotheses", "curve", "confirmation")
"""Fields of a VerdictReport that are not stored with it: they are known from its row, or computed when it is shown."""


@dataclass(frozen=True, slots=True)
class Confirmation(Document):
    """Improvement of a promotion, measured by a match of fixed length. `elo` and `interval` as in a VerdictReport."""

    verdict: str
    candidate: str
    opponent: str
    games: int
    score: float
    elo: float
    interval: tuple[float | None, float | None]
    difference: Difference | None


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictReport(Document):
    """The tests of one candidate with their evidence.

    outcome: `promote`, `reject`, `inconclusive`, `open`, or `void` with the reason in `note`.
    promoted: whether this verdict made the candidate champion.
    reason, remedy: what decided, with the scores of candidate and champion, and what would have to change for a
    promotion, in sentences. remedy is None after a promotion and while the verdict is open.
    note: why it did not promote although the opponent was beaten, or why it is void.
    model: of the gate, which decides the units of margins. alpha: error probability spent by this verdict.
    hypotheses: elo0 and elo1 in the unit of `model`, or two mean differences of returns.
    llr, bounds: log likelihood ratio at the end and its bounds; log wealths if returns are tested.
    curve: LLR after each block.
    blocks, games: counted ones. unique_games: distinct games among them.
    counts: blocks per cell, worst for the candidate first.
    score: the candidate's mean score. elo, interval: logistic Elo above the opponent with its 95 % interval; infinite
    bounds are None.
    difference: mean return minus that of the opponent if contestants are compared on the same side or the gate
    tests returns, else None.
    anchors: tests against anchors after the opponent was beaten. exploiters: paired tests after these.
    exploitability: the test of learned exploitability after all others; None if it was not reached or is not required.
    forfeits: contestant → its forfeits in the counted games, if any.
    confirmation: the confirmation match of its promotion.
    """

    verdict: str
    candidate: str
    opponent: str
    outcome: str
    promoted: bool
    reason: str
    remedy: str | None
    note: str | None
    opened_at: str
    closed_at: str | None
    model: str
    hypotheses: tuple[float, float]
    alpha: float
    llr: float
    bounds: tuple[float, float]
    curve: tuple[float, ...]
    blocks: int
    games: int
    unique_games: int
    counts: tuple[int, ...]
    score: float | None
    elo: float | None
    interval: tuple[float | None, float | None] | None
    difference: Difference | None
    anchors: tuple[AnchorReport, ...] = ()
    exploiters: tuple[ExploiterReport, ...] = ()
    exploitability: ExploitabilityReport | None = None
    forfeits: dict[str, Forfeits] = field(default_factory=dict)
    confirmation: Confirmation | None = None

    @property
    def further(self) -> tuple[CriterionReport, ...]:
        """The tests after that against the champion, in order."""
        last = () if self.exploitability is None else (self.exploitability,)
        return (*self.anchors, *self.exploiters, *last)

    def to_record(self) -> dict[str, Any]:
        """The document that is stored when the verdict is closed."""
        return {name: value for name, value in self.to_json().items() if name not in LATER}


def is_applied(registry: Registry, verdict: VerdictRow) -> bool:
    """Whether the champion was moved because of this verdict, even if it has changed since."""
    return any(event.verdict == verdict.id for event in registry.aliases.history(verdict.league))


def gate_result(contest: Contest, play: Callable[[Criterion], Criterion | None] | None = None) -> GateResult:
    """Decide the tests of a verdict from their matches in the ledger, up to the first that is not passed.

    play: plays a test before it is decided, and returns it with its schedule, or None if the verdict cannot continue.
    By default nothing is played.
    """
    gate, verdict = contest.gate, contest.verdict
    kinds = {kind.kind: kind for kind in CRITERIA}
    further = [kinds[record["kind"]].of_record(record) for record in verdict.tests]
    results: list[CriterionResult] = []
    forfeited = 0
    for planned in (ChampionTest(schedule=verdict.id), *further):
        test = planned if play is None else play(planned)
        if test is None or test.schedule is None:
            break
        result = test.result(contest, contest.ledger.matches(league=verdict.league, schedule=test.schedule))
        results.append(result)
        forfeited += 0 if gate.forfeits else forfeits(result.decision.counted, contest.candidate)
        if forfeited or result.decision.outcome != "promote":
            break
    return GateResult(gate, results[0], tuple(results[1:]), len(further), forfeited)


def verdict_of(registry: Registry, row: VerdictRow) -> VerdictReport:
    """Compute the record of a verdict, open or closed, from the ledger."""
    contest = Contest.of(registry, row)
    return evidence(contest, gate_result(contest), row.outcome, (row.evidence or {}).get("note"))


def evidence(contest: Contest, result: GateResult, outcome: str | None, note: str | None) -> VerdictReport:
    """Compute the record of a verdict.

    Args:
        contest: Its contest.
        result: What its games show.
        outcome: Its outcome; None while it is open.
        note: Why it is void, or was not applied.
    """
    registry, verdict, gate, decision = contest.registry, contest.verdict, contest.gate, result.champion.decision
    promoted, tests = is_applied(registry, verdict), (result.champion, *result.further)
    reports = [test.report for test in result.further]
    return VerdictReport(
        verdict=verdict.id,
        candidate=contest.candidate,
        opponent=contest.champion,
        outcome=outcome or OPEN,
        promoted=promoted,
        reason=result.reason(outcome, promoted, note),
        remedy=result.remedy(outcome, promoted),
        note=note,
        opened_at=iso_timestamp(verdict.opened_at),
        closed_at=iso_timestamp(verdict.closed_at) if verdict.closed_at else None,
        model=gate.model,
        hypotheses=(gate.return0, gate.return1) if gate.model == "returns" else (gate.elo0, gate.elo1),
        alpha=gate.alpha,
        **statistics(decision),
        **elo_statistics(decision),
        curve=decision.curve,
        difference=_difference_of_returns(contest, decision.counted),
        anchors=tuple(report for report in reports if isinstance(report, AnchorReport)),
        exploiters=tuple(report for report in reports if isinstance(report, ExploiterReport)),
        exploitability=next((report for report in reports if isinstance(report, ExploitabilityReport)), None),
        forfeits=forfeits_of_all([match for test in tests for match in test.decision.counted]),
        confirmation=confirmation(contest) if verdict.closed_at else None,
    )


def _difference_of_returns(contest: Contest, matches: Sequence[Match]) -> Difference | None:
    """Mean return of the candidate minus the champion's if their returns are compared or tested, else None."""
    is_shown = contest.schedule.scoring != "game" or contest.gate.model == "returns"
    return paired_difference(matches, contest.candidate) if is_shown else None


def confirmation(contest: Contest) -> Confirmation | None:
    """Improvement of a promotion measured by its confirmation match; None until that is complete.

    The match has a fixed length and no influence on the decision, so the estimate is unbiased. The estimate of the
    verdict itself is optimistic, because the test stopped when the results looked good.
    """
    verdict, ledger = contest.verdict, contest.ledger
    if (name := verdict.confirmation) is None:
        return None
    schedule, matches = ledger.schedule(name), ledger.matches(league=verdict.league, schedule=name)
    if len(matches) < schedule.length:
        return None
    counts = cell_counts(matches, contest.candidate)
    estimate = elo_estimate(counts)
    return Confirmation(
        verdict=verdict.id,
        candidate=contest.candidate,
        opponent=contest.champion,
        games=2 * len(matches),
        score=sum(i * n for i, n in enumerate(counts)) / (len(counts) - 1) / len(matches),
        elo=estimate.elo,
        interval=estimate.interval,
        difference=_difference_of_returns(contest, matches),
    )
