"""Evidence of a verdict, computed from the ledger: contestants, test statistics, outcome and reason."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from evaluation.gating.verdict_report import (
    anchor_report,
    confirmation,
    difference_of_returns,
    explained,
    exploitability_report,
    exploiter_report,
    gate_of,
    gate_result,
    gate_statistics,
)
from evaluation.results import (
    AnchorReport,
    Confirmation,
    Difference,
    Document,
    ExploitabilityReport,
    ExploiterReport,
    iso_timestamp,
)
from league.registry.changes import OPEN
from league.registry.registry import Registry
from league.registry.storage.rows import AliasEvent, VerdictRow


@dataclass(frozen=True, slots=True)
class VerdictEvidence(Document):
    """A verdict with its evidence.

    outcome: as in a VerdictReport, or `open`. reason, remedy: as in a VerdictReport.
    hypotheses: elo0 and elo1 in the unit of `model`, or two mean differences of returns.
    curve: LLR after each block; the test decides at `bounds`.
    counts: blocks per cell, worst for the candidate first.
    elo, interval, difference: as in a VerdictReport.
    alpha: error probability of the verdict. anchors: its non-inferiority tests. exploiters: its paired tests against
    exploiters. exploitability: as in a VerdictReport. confirmation: the confirmation match of its promotion.
    """

    verdict: str
    candidate: str
    opponent: str
    outcome: str
    promoted: bool
    reason: str
    remedy: str | None
    opened_at: str
    closed_at: str | None
    model: str
    hypotheses: tuple[float, float]
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
    alpha: float
    anchors: tuple[AnchorReport, ...]
    exploiters: tuple[ExploiterReport, ...]
    exploitability: ExploitabilityReport | None
    confirmation: Confirmation | None


def verdict_evidence(registry: Registry, verdict: VerdictRow, events: Sequence[AliasEvent]) -> VerdictEvidence:
    """Compute the evidence of a verdict. events: history of the champion alias."""
    candidate = f"{verdict.league}@{verdict.candidate}"
    gate = gate_of(verdict)
    result = gate_result(registry, verdict)
    decision = result.champion
    promoted = any(event.verdict == verdict.id for event in events)
    explanation = explained(registry, verdict, verdict.outcome, result, promoted, (verdict.evidence or {}).get("note"))
    return VerdictEvidence(
        verdict=verdict.id,
        candidate=candidate,
        opponent=verdict.champion,
        outcome=verdict.outcome or OPEN,
        promoted=promoted,
        reason=explanation.reason,
        remedy=explanation.remedy,
        opened_at=iso_timestamp(verdict.opened_at),
        closed_at=iso_timestamp(verdict.closed_at) if verdict.closed_at else None,
        model=gate.model,
        hypotheses=(gate.return0, gate.return1) if gate.model == "returns" else (gate.elo0, gate.elo1),
        **gate_statistics(decision),
        curve=decision.curve,
        difference=difference_of_returns(registry, verdict, decision.blocks),
        alpha=verdict.alpha,
        anchors=tuple(map(anchor_report, result.anchors)),
        exploiters=tuple(map(exploiter_report, result.exploiters)),
        exploitability=exploitability_report(result.exploitability, candidate),
        confirmation=confirmation(registry, verdict),
    )
