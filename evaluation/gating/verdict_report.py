"""What the games of a verdict show, computed from the ledger: the gate result, its report, and the confirmation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from evaluation.gating.explanation import Explanation, explain
from evaluation.gating.exploitability import exploitability_bound
from evaluation.gating.gate import Decision, cell_counts, decide_matches
from evaluation.gating.gate_result import (
    AnchorResult,
    CompanionResult,
    ExploitabilityResult,
    GateResult,
    PairedResult,
    combine_results,
    companion_result,
    name_of_champion,
)
from evaluation.gating.sequential_tests import SequentialTest
from evaluation.matches.game_records import forfeits, forfeits_of_all
from evaluation.results import (
    AnchorReport,
    Confirmation,
    Difference,
    ExploitabilityReport,
    ExploiterReport,
    VerdictReport,
)
from evaluation.statistics.payoff import paired_difference
from evaluation.statistics.sequential import elo_estimate
from league.config.gate import GateConfig
from league.registry.registry import Registry
from league.registry.storage.rows import VerdictRow
from league.results.ledger import Ledger
from league.results.records import GAMES_PER_BLOCK, Match
from league.verdict_tests import AnchorTest, ExploiterTest


def is_applied(registry: Registry, verdict: VerdictRow) -> bool:
    """Whether the champion was moved because of this verdict, even if it has changed since."""
    return any(event.verdict == verdict.id for event in registry.aliases.history(verdict.league))


def gate_of(verdict: VerdictRow) -> GateConfig:
    """The gate's settings when the verdict was opened, including its α."""
    return GateConfig.model_validate(verdict.settings["gate"])


def gate_statistics(decision: Decision) -> dict[str, Any]:
    """The fields of a report that describe a sequential test. Infinite bounds are None."""
    estimate = decision.estimate
    return _test_statistics(decision) | {
        "score": decision.score,
        "elo": estimate and _finite(estimate.elo),
        "interval": estimate and (_finite(estimate.low), _finite(estimate.high)),
    }


def _test_statistics(decision: Decision) -> dict[str, Any]:
    """The fields of a CompanionReport."""
    return {
        "llr": decision.llr,
        "bounds": decision.bounds,
        "blocks": decision.blocks,
        "games": decision.games,
        "unique_games": decision.unique_games or 0,
        "counts": decision.counts,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _matches(registry: Registry, verdict: VerdictRow, schedule: str | None = None) -> Sequence[Match]:
    return Ledger(registry).matches(league=verdict.league, schedule=schedule or verdict.schedule)


def gate_result(registry: Registry, verdict: VerdictRow) -> GateResult:
    """Compute the gate result of a verdict from the ledger."""
    gate, candidate_ref, tests = gate_of(verdict), verdict.candidate_ref, verdict.companions
    matches = _matches(registry, verdict)
    champion = decide_matches(SequentialTest(gate, candidate_ref), matches)
    forfeited = forfeits(matches[: champion.blocks], candidate_ref)
    companions: list[CompanionResult] = []
    for test in tests.ready:
        matches = _matches(registry, verdict, test.schedule)
        result = companion_result(gate, test, candidate_ref, verdict.champion, matches)
        companions.append(result)
        forfeited += forfeits(matches[: result.decision.games // GAMES_PER_BLOCK], candidate_ref)
    opponent = name_of_champion(verdict.champion)
    finding = f"it beat {opponent}" if gate.requires_gain else f"it is not inferior to {opponent}"
    return combine_results(champion, companions, tests.number, None if gate.forfeits else forfeited, finding)


def difference_of_returns(
    registry: Registry, verdict: VerdictRow, blocks: int | None = None, name: str | None = None
) -> Difference | None:
    """Mean return of the candidate minus the champion's if their returns are compared or tested, else None.

    Args:
        registry: The registry of the verdict.
        verdict: The verdict.
        blocks: Number of matches, by default all.
        name: Schedule of the matches, by default that of the verdict.
    """
    if Ledger(registry).schedule(verdict.schedule).scoring == "game" and gate_of(verdict).model != "returns":
        return None
    return paired_difference(_matches(registry, verdict, name)[:blocks], verdict.candidate_ref)


def report_of(
    registry: Registry, verdict: VerdictRow, outcome: str, seen: GateResult, note: str | None
) -> VerdictReport:
    """Report of a verdict that ends with this gate result."""
    promoted = is_applied(registry, verdict)
    explanation = explained(registry, verdict, outcome, seen, promoted, note)
    return VerdictReport(
        verdict=verdict.id,
        candidate=verdict.candidate_ref,
        opponent=verdict.champion,
        outcome=outcome,
        **gate_statistics(seen.champion),
        promoted=promoted,
        alpha=verdict.alpha,
        model=gate_of(verdict).model,
        anchors=tuple(map(anchor_report, seen.anchors)),
        exploiters=tuple(map(exploiter_report, seen.exploiters)),
        exploitability=exploitability_report(seen.exploitability, verdict.candidate_ref),
        difference=difference_of_returns(registry, verdict, seen.champion.blocks),
        note=note,
        forfeits=forfeits_of_all(_counted(registry, verdict, seen)),
        reason=explanation.reason,
        remedy=explanation.remedy,
    )


def _counted(registry: Registry, verdict: VerdictRow, seen: GateResult) -> Iterator[Match]:
    """The matches of a verdict that count."""
    yield from _matches(registry, verdict)[: seen.champion.blocks]
    for companion in seen.companions:
        games = companion.decision.games
        yield from _matches(registry, verdict, companion.test.schedule)[: games // GAMES_PER_BLOCK]


def explained(
    registry: Registry, verdict: VerdictRow, outcome: str | None, seen: GateResult, promoted: bool, note: str | None
) -> Explanation:
    """Explain a verdict with this gate result. outcome: None while it is open. note: as in a VerdictReport."""
    absolute = [companion.test.ref for companion in seen.companions if isinstance(companion, AnchorResult)]
    scores = {ref: score for ref in absolute if (score := _champion_score(registry, verdict, ref)) is not None}
    return explain(
        verdict, gate_of(verdict), seen, outcome=outcome, promoted=promoted, note=note, champion_scores=scores
    )


def _champion_score(registry: Registry, verdict: VerdictRow, opponent: str) -> float | None:
    """Mean score of the champion against an opponent in all games under the verdict's conditions; None without any."""
    ledger = Ledger(registry)
    conditions = ledger.schedule(verdict.schedule).conditions
    blocks = ledger.results(verdict.league, conditions, between=(verdict.champion, opponent))
    points = sum(block.scores[block.contestants.index(verdict.champion)] for block in blocks)
    return points / sum(block.games for block in blocks) if blocks else None


OUTCOMES = {"promote": "not inferior", "reject": "inferior", "inconclusive": "inconclusive", None: "open"}
PAIRED_OUTCOMES = OUTCOMES | {"promote": "not worse", "reject": "worse"}


def anchor_report(anchor: AnchorResult | PairedResult) -> AnchorReport:
    """Report of one test against an anchor."""
    assert isinstance(anchor.test, AnchorTest), "it is the result of an anchor"
    statistics, outcomes = gate_statistics(anchor.decision), OUTCOMES
    if isinstance(anchor, PairedResult):
        statistics, outcomes = statistics | _paired_statistics(anchor), PAIRED_OUTCOMES
    return AnchorReport(
        ref=anchor.test.ref,
        margin=anchor.test.margin,
        schedule=anchor.test.schedule,
        outcome=outcomes[anchor.decision.outcome],
        **statistics,
        mode=anchor.test.mode,
    )


def exploiter_report(exploiter: PairedResult) -> ExploiterReport:
    """Report of one paired test against an exploiter."""
    assert isinstance(exploiter.test, ExploiterTest), "it is the result of an exploiter"
    return ExploiterReport(
        ref=exploiter.test.ref,
        exploits=exploiter.test.exploits,
        margin=exploiter.test.margin,
        schedule=exploiter.test.schedule,
        outcome=PAIRED_OUTCOMES[exploiter.decision.outcome],
        **_test_statistics(exploiter.decision),
        **_paired_statistics(exploiter),
    )


def _paired_statistics(result: PairedResult) -> dict[str, Any]:
    score, champion_score = result.scores or (None, None)
    return {"score": score, "champion_score": champion_score, "difference": result.difference}


EXPLOITABILITY_OUTCOMES = OUTCOMES | {"promote": "not more exploitable", "reject": "more exploitable"}
IMPROVEMENT_OUTCOMES = OUTCOMES | {"promote": "less exploitable", "reject": "not less exploitable"}


def exploitability_report(result: ExploitabilityResult | None, candidate: str) -> ExploitabilityReport | None:
    """Report of the test of exploitability."""
    if result is None:
        return None
    test, champion = result.test, result.champion
    exploiters = {candidate: test.of_candidate, champion: test.of_champion}
    bounds = {
        ref: exploitability_bound(ref, own_exploiters, result.sample)
        for ref, own_exploiters in exploiters.items()
        if result.sample
    }
    outcomes = IMPROVEMENT_OUTCOMES if test.improvement else EXPLOITABILITY_OUTCOMES
    return ExploitabilityReport(
        ref=champion,
        margin=test.margin,
        improvement=test.improvement,
        schedule=test.schedule,
        outcome=outcomes[result.decision.outcome],
        **_test_statistics(result.decision),
        candidate=bounds.get(candidate),
        champion=bounds.get(champion),
        difference=result.difference,
        difference_over_exploiters=result.difference_over_exploiters,
    )


def confirmation(registry: Registry, verdict: VerdictRow) -> Confirmation | None:
    """Improvement of a promotion measured by its confirmation match; None until that is complete.

    The match has a fixed length and no influence on the decision, so the estimate is unbiased. The estimate of the
    verdict itself is optimistic, because the test stopped when the results looked good.
    """
    name = verdict.companions.confirmation
    if name is None:
        return None
    schedule, matches = Ledger(registry).schedule(name), _matches(registry, verdict, name)
    if len(matches) < schedule.length:
        return None
    counts = cell_counts(matches, verdict.candidate_ref)
    estimate = elo_estimate(counts, "logistic")
    return Confirmation(
        verdict=verdict.id,
        candidate=verdict.candidate_ref,
        opponent=verdict.champion,
        games=2 * len(matches),
        score=sum(i * n for i, n in enumerate(counts)) / (len(counts) - 1) / len(matches),
        elo=estimate.elo,
        interval=(_finite(estimate.low), _finite(estimate.high)),
        difference=difference_of_returns(registry, verdict, name=name),
    )
