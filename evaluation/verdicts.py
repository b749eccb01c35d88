"""One verdict from its opening to its end, at any point of which the process may die and another go on.

    schedule in the ledger → verdict opened → matches → decision → champion moved → verdict closed

The order makes every step repeatable. A verdict that is open has its schedule. What was played is in the
ledger, and the decision follows from it. The champion moves while the verdict is still open, and the audit
row names it: so a verdict that was interrupted there is closed, and never applied twice, even if the champion
was rolled back in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from evaluation import promotion, tournament
from evaluation.gate import Decision, Watch, floor, judge
from evaluation.paired import paired_difference
from evaluation.report import Difference, Listener, Progress, VerdictReport
from evaluation.schedule import verdict as verdict_schedule
from league.config import GateConfig
from league.refs import CHAMPION
from league.registry.registry import Registry
from league.registry.rows import LeagueRow, VerdictRow
from league.results.ledger import Ledger
from league.results.records import Match, Schedule

VOID = "void"


def stands(verdict: VerdictRow) -> bool:
    """Whether a verdict settles the matter, or will: it is neither void, nor was its promotion refused."""
    if verdict.outcome == "promote":
        return bool(verdict.evidence and verdict.evidence["promoted"])
    return verdict.outcome != VOID


def open_verdict(registry: Registry, league: LeagueRow, candidate: int, opponent: str) -> VerdictRow:
    """Open a verdict on `candidate` against `opponent`, or find it open.

    One that does not stand is followed by another on other games, never by the same once more.
    """
    spent = [
        row
        for row in registry.verdicts(league.slug)
        if (row.candidate, row.champion) == (candidate, opponent) and row.outcome is not None
    ]
    challenger = f"{league.slug}@{candidate}"
    schedule = verdict_schedule(league.config, league.interface, challenger, opponent, seed=len(spent))
    Ledger(registry).open(schedule)
    settings = {"gate": league.config.gate.model_dump(mode="json")}
    return registry.open_verdict(league.slug, candidate, opponent, schedule.id, settings)


def conclude(
    registry: Registry, verdict: VerdictRow, *, workers: int = 0, listener: Listener | None = None
) -> VerdictReport:
    """Play an open verdict to its end, move the champion if it says so, and close it."""
    if (obstacle := _obstacle(registry, verdict)) is not None:
        return _close(registry, verdict, VOID, _decision(registry, verdict), note=obstacle)
    watch = Watch(gate_of(verdict), _challenger(verdict))

    def report(progress: Progress | VerdictReport) -> None:
        if listener and isinstance(progress, Progress):
            listener(replace(progress, llr=watch.llr, bounds=watch.bounds))

    tournament.run(
        _schedule(registry, verdict), registry=registry, workers=workers, enough=watch.is_over, listener=report
    )
    decision = _decision(registry, verdict)
    assert decision.outcome is not None, "a schedule ends where its test does"
    refused = None
    if decision.outcome == "promote":
        refused = promotion.apply(registry, verdict, _reason(verdict, decision))
    return _close(registry, verdict, decision.outcome, decision, note=refused)


def _obstacle(registry: Registry, verdict: VerdictRow) -> str | None:
    """Why this verdict cannot go on: it would be about a champion, or an environment, of the past, or in vain."""
    if promotion.is_applied(registry, verdict):
        return None
    now = registry.aliases(verdict.league).get(CHAMPION)
    if now != promotion.tested_champion(verdict):
        holder = "there is no champion" if now is None else f"the champion is {verdict.league}@{now}"
        return f"{holder} now, and {verdict.champion} was tested against"
    if _schedule(registry, verdict).environment_digest != registry.league(verdict.league).environment_digest:
        return "the league's environment has been changed since"
    return None if now is None else _below_floor(registry, verdict, now)


def _below_floor(registry: Registry, verdict: VerdictRow, champion: int) -> str | None:
    """Why the candidate is not even tested: it has not shown enough as the champion's shadow."""
    for shadowing in registry.shadowings(verdict.league):
        if (shadowing.candidate, shadowing.champion) == (verdict.candidate, champion):
            latency = shadowing.milliseconds(0.95)
            seen = shadowing.observations, shadowing.failed, shadowing.agreement
            return floor(gate_of(verdict), *seen, latency)
    return floor(gate_of(verdict), 0, 0, None, None)


def _schedule(registry: Registry, verdict: VerdictRow) -> Schedule:
    return Ledger(registry).schedule(verdict.schedule)


def gate_of(verdict: VerdictRow) -> GateConfig:
    """The settings under which it was opened."""
    return GateConfig.model_validate(verdict.settings["gate"])


def _challenger(verdict: VerdictRow) -> str:
    return f"{verdict.league}@{verdict.candidate}"


def _matches(registry: Registry, verdict: VerdictRow) -> Sequence[Match]:
    return Ledger(registry).matches(league=verdict.league, schedule=verdict.schedule)


def _decision(registry: Registry, verdict: VerdictRow) -> Decision:
    return judge(gate_of(verdict), _matches(registry, verdict), _challenger(verdict))


def _difference(registry: Registry, verdict: VerdictRow, decision: Decision) -> Difference | None:
    if _schedule(registry, verdict).scoring == "game":
        return None
    return paired_difference(_matches(registry, verdict)[: decision.blocks], _challenger(verdict))


def _reason(verdict: VerdictRow, decision: Decision) -> str:
    return (
        f"beat {verdict.champion} over {decision.games} games: score {decision.score:.3f},"
        f" LLR {decision.llr:.2f} of {decision.bounds[1]:.2f}"
    )


def _close(
    registry: Registry, verdict: VerdictRow, outcome: str, decision: Decision, note: str | None
) -> VerdictReport:
    report = report_of(registry, verdict, outcome, decision, note)
    registry.close_verdict(verdict.id, outcome, evidence_of(report, decision))
    return report


def report_of(
    registry: Registry, verdict: VerdictRow, outcome: str, decision: Decision, note: str | None
) -> VerdictReport:
    """What is told of a verdict that ends with this decision."""
    estimate = decision.estimate
    return VerdictReport(
        verdict=verdict.id,
        candidate=_challenger(verdict),
        opponent=verdict.champion,
        outcome=outcome,
        llr=decision.llr,
        bounds=decision.bounds,
        blocks=decision.blocks,
        games=decision.games,
        distinct_games=decision.distinct_games or 0,
        score=decision.score,
        elo=estimate.elo if estimate else None,
        interval=(estimate.low, estimate.high) if estimate else None,
        promoted=promotion.is_applied(registry, verdict),
        difference=_difference(registry, verdict, decision),
        note=note,
    )


def evidence_of(report: VerdictReport, decision: Decision) -> dict[str, Any]:
    """What is recorded of it."""
    return report.to_json() | {"counts": list(decision.counts)}
