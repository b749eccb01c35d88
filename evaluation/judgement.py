"""A verdict with all its evidence, computed from the ledger: what it is about, how it went, and why it came out so."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from evaluation.gate import Decision
from evaluation.paired import paired_difference
from evaluation.report import AnchorReport, Confirmation, Difference, Document, when
from evaluation.verdicts import anchor_report, confirmation, findings, gate_of
from league.registry.registry import Registry
from league.registry.rows import AliasEvent, VerdictRow
from league.results.ledger import Ledger

OPEN = "open"


@dataclass(frozen=True, slots=True)
class Judgement(Document):
    """A verdict with its evidence, computed from the ledger.

    outcome: a verdict's, or `open`. reason: why it came out so, in a sentence.
    hypotheses: elo0 and elo1 in `model`, or two mean differences of returns.
    curve: the LLR after each block; it decides at `bounds`.
    counts: blocks in each cell, worst for the candidate first.
    elo, interval, difference: as in a VerdictReport.
    alpha: the error that the verdict may spend. anchors: its tests of non-inferiority. confirmation: the fresh match
    after its promotion.
    """

    verdict: str
    candidate: str
    opponent: str
    outcome: str
    promoted: bool
    reason: str
    opened_at: str
    closed_at: str | None
    model: str
    hypotheses: tuple[float, float]
    llr: float
    bounds: tuple[float, float]
    curve: tuple[float, ...]
    blocks: int
    games: int
    distinct_games: int
    counts: tuple[int, ...]
    score: float | None
    elo: float | None
    interval: tuple[float | None, float | None] | None
    difference: Difference | None
    alpha: float
    anchors: tuple[AnchorReport, ...]
    confirmation: Confirmation | None


def judgement(registry: Registry, verdict: VerdictRow, events: Sequence[AliasEvent]) -> Judgement:
    """Read all that there is to say of a verdict. events: of the champion's history."""
    candidate = f"{verdict.league}@{verdict.candidate}"
    gate = gate_of(verdict)
    seen = findings(registry, verdict)
    decision = seen.champion
    promoted = any(event.verdict == verdict.id for event in events)
    estimate = decision.estimate
    return Judgement(
        verdict=verdict.id,
        candidate=candidate,
        opponent=verdict.champion,
        outcome=verdict.outcome or OPEN,
        promoted=promoted,
        reason=_reason(verdict, decision, promoted),
        opened_at=when(verdict.opened_at),
        closed_at=when(verdict.closed_at) if verdict.closed_at else None,
        model=gate.model,
        hypotheses=(gate.return0, gate.return1) if gate.model == "returns" else (gate.elo0, gate.elo1),
        llr=decision.llr,
        bounds=decision.bounds,
        curve=decision.curve,
        blocks=decision.blocks,
        games=decision.games,
        distinct_games=decision.distinct_games or 0,
        counts=decision.counts,
        score=decision.score,
        elo=_finite(estimate.elo) if estimate else None,
        interval=(_finite(estimate.low), _finite(estimate.high)) if estimate else None,
        difference=_difference(registry, verdict, candidate, decision.blocks),
        alpha=verdict.alpha,
        anchors=tuple(map(anchor_report, seen.anchors)),
        confirmation=confirmation(registry, verdict),
    )


def _difference(registry: Registry, verdict: VerdictRow, candidate: str, blocks: int) -> Difference | None:
    ledger = Ledger(registry)
    if ledger.schedule(verdict.schedule).scoring != "side":
        return None
    return paired_difference(ledger.matches(league=verdict.league, schedule=verdict.schedule)[:blocks], candidate)


def _reason(verdict: VerdictRow, decision: Decision, promoted: bool) -> str:
    """Why a verdict came out as it did, in a sentence."""
    note = (verdict.evidence or {}).get("note")
    llr, lower, upper = (f"{value:.2f}".replace("-", "−") for value in (decision.llr, *decision.bounds))
    after = f"after {decision.games} games the LLR was {llr}"
    match verdict.outcome:
        case None:
            return f"It is not decided yet: {after}, between {lower} and {upper}."
        case "promote" if promoted:
            return f"It is the stronger one: {after}, and {upper} is enough."
        case "promote":
            return f"It is the stronger one ({after}), but was not promoted: {note or 'no reason was recorded'}."
        case "inconclusive":
            return note or f"Nothing was decided: {after}, between {lower} and {upper}, and no more are played."
        case "reject" if note is None and decision.llr <= decision.bounds[0]:
            return f"It is not the stronger one: {after}, and below {lower} it is given up."
    return note or f"{str(verdict.outcome).capitalize()}: {after}."


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
