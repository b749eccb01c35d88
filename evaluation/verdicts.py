"""One verdict from its opening to its end, at any point of which the process may die and another go on.

    schedules in the ledger → verdict opened → matches → findings → champion moved → verdict closed

The order makes every step repeatable. A verdict that is open has its schedules: against the champion, against each
anchor, and for the match that confirms a promotion. What was played is in the ledger, and the findings follow from it.
The champion moves while the verdict is still open, and the audit row names it: so a verdict that was interrupted there
is closed, and never applied twice, even if the champion was rolled back in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from evaluation import promotion, tournament
from evaluation.anchors import anchors_of
from evaluation.findings import Anchored, Findings, found
from evaluation.forfeits import forfeits
from evaluation.gate import Watch, counts_of, floor, judge
from evaluation.paired import paired_difference
from evaluation.report import AnchorReport, Confirmation, Difference, Listener, Progress, VerdictReport
from evaluation.schedule import beside
from evaluation.schedule import verdict as verdict_schedule
from evaluation.sequential import elo_estimate
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


def open_verdict(
    registry: Registry,
    league: LeagueRow,
    candidate: int,
    opponent: str,
    alpha: float | None = None,
    night: int | None = None,
) -> VerdictRow:
    """Open a verdict on `candidate` against `opponent`, or find it open.

    One that does not stand is followed by another on other games, never by the same once more.
    alpha: what it spends, by default the gate's. night: the one that it belongs to.
    """
    spent = [
        row
        for row in registry.verdicts(league.slug)
        if (row.candidate, row.champion) == (candidate, opponent) and row.outcome is not None
    ]
    config, challenger, ledger = league.config, f"{league.slug}@{candidate}", Ledger(registry)
    gate = config.gate.of_one_verdict(config.gate.alpha if alpha is None else alpha)
    schedule = verdict_schedule(config, league.interface, challenger, opponent, gate, seed=len(spent))
    ledger.open(schedule)
    settings: dict[str, Any] = {"gate": gate.model_dump(mode="json"), "night": night, "anchors": []}
    for anchor in anchors_of(registry, league, candidate, opponent):
        own = beside(config, league.interface, "anchor", schedule, anchor.ref, gate.max_blocks)
        settings["anchors"].append(
            {"ref": anchor.ref, "margin": anchor.margin or gate.margin, "schedule": ledger.open(own).id}
        )
    if gate.confirmation_blocks:
        own = beside(config, league.interface, "confirmation", schedule, opponent, gate.confirmation_blocks)
        settings["confirmation"] = ledger.open(own).id
    return registry.open_verdict(league.slug, candidate, opponent, schedule.id, settings)


def conclude(
    registry: Registry, verdict: VerdictRow, *, workers: int = 0, listener: Listener | None = None
) -> VerdictReport:
    """Play an open verdict to its end, move the champion if it says so, and close it.

    One that a person voids meanwhile ends where it is.
    """
    if (obstacle := _obstacle(registry, verdict)) is not None:
        return _close(registry, verdict, VOID, findings(registry, verdict), note=obstacle)
    for schedule, gate in _tests(registry, verdict):
        _play(registry, verdict, schedule, gate, workers, listener)
        stopped = registry.verdict(verdict.id)
        seen = findings(registry, verdict)
        if stopped.outcome is not None:
            return report_of(registry, verdict, stopped.outcome, seen, (stopped.evidence or {}).get("note"))
        if seen.outcome is not None:
            break
    assert seen.outcome is not None, "a schedule ends where its test does"
    refused = promotion.apply(registry, verdict, _reason(verdict, seen)) if seen.outcome == "promote" else seen.note
    return _close(registry, verdict, seen.outcome, seen, note=refused)


def void(registry: Registry, verdict: str, *, actor: str, reason: str, purge: bool = False) -> VerdictRow:
    """Stop a verdict that is open, or take back one that has fallen. Its alpha is spent: what was seen of it may have
    been the reason. The candidate is judged again, on other games; a promotion that it led to stays.

    purge: its games, which stay in the ledger, count for nothing any more.
    Raises NotFound, or Conflict for one whose promotion is just being applied.
    """
    row = registry.void_verdict(verdict, f"voided by {actor}: {reason}")
    if purge:
        Ledger(registry).purge(schedules_of(row))
    return row


def schedules_of(verdict: VerdictRow) -> list[str]:
    """The ids of the schedules whose matches are a verdict's own."""
    anchors = [anchor["schedule"] for anchor in verdict.settings.get("anchors", ())]
    confirmation = verdict.settings.get("confirmation")
    return [verdict.schedule, *anchors, *([confirmation] if confirmation else [])]


def _tests(registry: Registry, verdict: VerdictRow) -> list[tuple[Schedule, GateConfig]]:
    """The schedules of a verdict in their order, each with what decides it."""
    ledger, gate = Ledger(registry), gate_of(verdict)
    return [
        (_schedule(registry, verdict), gate),
        *(
            (ledger.schedule(anchor["schedule"]), gate.against_anchor(anchor["margin"]))
            for anchor in verdict.settings.get("anchors", ())
        ),
    ]


def _play(
    registry: Registry,
    verdict: VerdictRow,
    schedule: Schedule,
    gate: GateConfig,
    workers: int,
    listener: Listener | None,
) -> None:
    """Play one of its tests until that is decided, or the verdict is closed by somebody else."""
    watch = Watch(gate, _challenger(verdict))

    def report(progress: Progress | VerdictReport) -> None:
        if listener and isinstance(progress, Progress):
            listener(replace(progress, llr=watch.llr, bounds=watch.bounds))

    def enough(matches: Sequence[Match]) -> bool:
        return watch.is_over(matches) or registry.verdict(verdict.id).outcome is not None

    tournament.run(schedule, registry=registry, workers=workers, enough=enough, listener=report)


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
    """The settings under which it was opened, its own alpha among them."""
    return GateConfig.model_validate(verdict.settings["gate"])


def _challenger(verdict: VerdictRow) -> str:
    return f"{verdict.league}@{verdict.candidate}"


def _matches(registry: Registry, verdict: VerdictRow, schedule: str | None = None) -> Sequence[Match]:
    return Ledger(registry).matches(league=verdict.league, schedule=schedule or verdict.schedule)


def findings(registry: Registry, verdict: VerdictRow) -> Findings:
    """What the ledger says of a verdict's challenger."""
    gate, challenger = gate_of(verdict), _challenger(verdict)
    matches = _matches(registry, verdict)
    champion = judge(gate, matches, challenger)
    forfeited = forfeits(matches[: champion.blocks], challenger)
    anchors = []
    for anchor in verdict.settings.get("anchors", ()):
        ref, margin, schedule = anchor["ref"], anchor["margin"], anchor["schedule"]
        matches = _matches(registry, verdict, schedule)
        anchors.append(Anchored(ref, margin, schedule, judge(gate.against_anchor(margin), matches, challenger)))
        forfeited += forfeits(matches[: anchors[-1].decision.blocks], challenger)
    return found(champion, anchors, len(anchors), None if gate.forfeits else forfeited)


def _difference(registry: Registry, verdict: VerdictRow, seen: Findings) -> Difference | None:
    if _schedule(registry, verdict).scoring == "game" and gate_of(verdict).model != "returns":
        return None
    return paired_difference(_matches(registry, verdict)[: seen.champion.blocks], _challenger(verdict))


def _reason(verdict: VerdictRow, seen: Findings) -> str:
    decision = seen.champion
    beside = f", and is not inferior to {', '.join(each.ref for each in seen.anchors)}" if seen.anchors else ""
    return (
        f"beat {verdict.champion} over {decision.games} games: score {decision.score:.3f},"
        f" LLR {decision.llr:.2f} of {decision.bounds[1]:.2f}{beside}"
    )


def _close(registry: Registry, verdict: VerdictRow, outcome: str, seen: Findings, note: str | None) -> VerdictReport:
    report = report_of(registry, verdict, outcome, seen, note)
    registry.close_verdict(verdict.id, outcome, evidence_of(report))
    return report


def report_of(registry: Registry, verdict: VerdictRow, outcome: str, seen: Findings, note: str | None) -> VerdictReport:
    """What is told of a verdict that ends with these findings."""
    decision, estimate = seen.champion, seen.champion.estimate
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
        counts=decision.counts,
        score=decision.score,
        elo=estimate.elo if estimate else None,
        interval=(estimate.low, estimate.high) if estimate else None,
        promoted=promotion.is_applied(registry, verdict),
        alpha=verdict.alpha,
        anchors=tuple(anchor_report(anchor) for anchor in seen.anchors),
        difference=_difference(registry, verdict, seen),
        note=note,
    )


OUTCOMES = {"promote": "not inferior", "reject": "inferior", "inconclusive": "inconclusive", None: "open"}


def anchor_report(anchor: Anchored) -> AnchorReport:
    """What is told of one test of non-inferiority."""
    decision, estimate = anchor.decision, anchor.decision.estimate
    return AnchorReport(
        ref=anchor.ref,
        margin=anchor.margin,
        schedule=anchor.schedule,
        outcome=OUTCOMES[decision.outcome],
        llr=decision.llr,
        bounds=decision.bounds,
        blocks=decision.blocks,
        games=decision.games,
        distinct_games=decision.distinct_games or 0,
        counts=decision.counts,
        score=decision.score,
        elo=estimate.elo if estimate else None,
        interval=(estimate.low, estimate.high) if estimate else None,
    )


def evidence_of(report: VerdictReport) -> dict[str, Any]:
    """What is recorded of it."""
    return report.to_json()


def confirm(
    registry: Registry, verdict: VerdictRow, *, workers: int = 0, listener: Listener | None = None
) -> Confirmation | None:
    """Play the fresh match of a verdict that promoted, to its end, and tell how much was gained.

    None where nothing was promoted, no confirmation was asked for, or the environment is another by now.
    """
    schedule = verdict.settings.get("confirmation")
    if verdict.outcome != "promote" or not stands(verdict) or schedule is None:
        return None
    whole = Ledger(registry).schedule(schedule)
    if whole.environment_digest != registry.league(verdict.league).environment_digest:
        return None
    tournament.run(whole, registry=registry, workers=workers, listener=listener)
    return confirmation(registry, verdict)


def confirmation(registry: Registry, verdict: VerdictRow) -> Confirmation | None:
    """How much a promotion gained, by its fresh match; None while that is not played to its end.

    Its length was fixed before, and it has no part in the decision: so the estimate is unbiased, where that of the
    verdict itself, which stopped because it looked good, is too good.
    """
    name = verdict.settings.get("confirmation")
    if name is None:
        return None
    schedule, matches = Ledger(registry).schedule(name), _matches(registry, verdict, name)
    if len(matches) < schedule.length:
        return None
    counts = counts_of(matches, _challenger(verdict))
    estimate = elo_estimate(counts, "logistic")
    return Confirmation(
        verdict=verdict.id,
        candidate=_challenger(verdict),
        opponent=verdict.champion,
        games=2 * len(matches),
        score=sum(i * n for i, n in enumerate(counts)) / (len(counts) - 1) / len(matches),
        elo=estimate.elo,
        interval=(estimate.low, estimate.high),
        difference=None if schedule.scoring == "game" else paired_difference(matches, _challenger(verdict)),
    )
