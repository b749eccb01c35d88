"""A verdict from its opening to the promotion. The process may be killed at any point; another one resumes.

schedules in the ledger → verdict opened → matches → gate result → champion moved → verdict closed

The order makes every step repeatable. An open verdict has its schedules: against the champion, against each anchor and
each exploiter, and for the confirmation match of a promotion. The gate result follows from the matches in the ledger.
The champion moves while the verdict is still open, and the audit row names the verdict. A verdict that was interrupted
there is closed and never applied twice, even if the champion was rolled back meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from evaluation.gating.anchors import resolve_anchors
from evaluation.gating.exploiters import recent_exploiters
from evaluation.gating.gate import (
    AnchorResult,
    CompanionResult,
    Decision,
    ExploiterResult,
    GateResult,
    SequentialMonitor,
    cell_counts,
    combine_results,
    decide_matches,
    exploiter_result,
    shadow_shortfall,
)
from evaluation.matches import tournament
from evaluation.matches.game_records import forfeits
from evaluation.results import (
    AnchorReport,
    Confirmation,
    Difference,
    ExploiterReport,
    Listener,
    Progress,
    VerdictReport,
)
from evaluation.schedules.builders import companion, exploiter_test
from evaluation.schedules.builders import verdict as verdict_schedule
from evaluation.statistics.payoff import paired_difference
from evaluation.statistics.sequential import elo_estimate
from league.config.gate import GateConfig
from league.errors import AliasMoved
from league.refs import CHAMPION, CheckpointRef, RemoteRef, ScriptRef, parse_ref
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow, VerdictRow
from league.registry.verdicts import VOID
from league.results.ledger import Ledger
from league.results.records import Match, Schedule

ACTOR = "league nightly"


def is_applied(registry: Registry, verdict: VerdictRow) -> bool:
    """Whether the champion was moved because of this verdict, even if it has changed since."""
    return any(event.verdict == verdict.id for event in registry.aliases.history(verdict.league))


def tested_champion(verdict: VerdictRow) -> int | None:
    """Number of the champion that the candidate played; None if the opponent was not a version."""
    match parse_ref(verdict.champion):
        case CheckpointRef(version=int(number)):
            return number
        case ScriptRef() | RemoteRef():
            return None
    raise AssertionError(f"verdict {verdict.id} names {verdict.champion}, which is not a fixed version")


def promote(registry: Registry, verdict: VerdictRow, reason: str) -> str | None:
    """Make the verdict's candidate champion, once. Returns None, or the reason of a refusal.

    The promotion is refused if the champion is no longer the one that the candidate was tested against. Repeated calls
    have no effect.
    """
    if is_applied(registry, verdict):
        return None
    try:
        registry.aliases.set(
            verdict.league,
            CHAMPION,
            verdict.candidate,
            expected=tested_champion(verdict),
            actor=ACTOR,
            reason=reason,
            verdict=verdict.id,
        )
    except AliasMoved as error:
        return str(error)
    return None


def is_effective(verdict: VerdictRow) -> bool:
    """Whether a verdict is or will be final: neither void nor refused its promotion."""
    if verdict.outcome == "promote":
        return bool(verdict.evidence and verdict.evidence["promoted"])
    return verdict.outcome != VOID


def open_verdict(
    registry: Registry,
    league: LeagueRow,
    candidate: int,
    opponent: str,
    alpha: float | None = None,
    nightly_run: int | None = None,
) -> VerdictRow:
    """Open a verdict on `candidate` against `opponent`, or return the open one.

    After an ineffective verdict, the next one plays other games.
    alpha: error probability; by default that of the gate. nightly_run: id of the nightly run.
    """
    spent = [
        row
        for row in registry.verdicts.all(league.slug)
        if (row.candidate, row.champion) == (candidate, opponent) and row.outcome is not None
    ]
    config, candidate_ref, ledger = league.config, f"{league.slug}@{candidate}", Ledger(registry)
    gate = config.gate.of_one_verdict(config.gate.alpha if alpha is None else alpha)
    schedule = verdict_schedule(config, league.interface, candidate_ref, opponent, gate, seed=len(spent))
    ledger.open(schedule)
    settings: dict[str, Any] = {"gate": gate.model_dump(mode="json"), "night": nightly_run}
    settings |= {"anchors": [], "exploiters": []}
    for anchor in resolve_anchors(registry, league, candidate, opponent):
        own = companion(config, league.interface, "anchor", schedule, anchor.ref, gate.max_blocks)
        settings["anchors"].append(
            {"ref": anchor.ref, "margin": anchor.margin or gate.margin, "schedule": ledger.open(own).id}
        )
    for exploiter in recent_exploiters(registry, league, opponent):
        own = exploiter_test(config, league.interface, schedule, exploiter.ref, gate.max_blocks)
        record = {"ref": exploiter.ref, "exploits": exploiter.exploits, "margin": gate.margin_against_exploiters}
        settings["exploiters"].append(record | {"schedule": ledger.open(own).id})
    if gate.confirmation_blocks:
        own = companion(config, league.interface, "confirmation", schedule, opponent, gate.confirmation_blocks)
        settings["confirmation"] = ledger.open(own).id
    return registry.verdicts.open(league.slug, candidate, opponent, schedule.id, settings)


def conclude(
    registry: Registry, verdict: VerdictRow, *, workers: int = 0, listener: Listener | None = None
) -> VerdictReport:
    """Play an open verdict to its end, move the champion if it was beaten, and close the verdict.

    A verdict that a person voids meanwhile ends immediately.
    """
    if (obstacle := _obstacle(registry, verdict)) is not None:
        return _close(registry, verdict, VOID, gate_result(registry, verdict), note=obstacle)
    for schedule, watch in _tests(registry, verdict):
        _play(registry, verdict, schedule, watch, workers, listener)
        stopped = registry.verdicts.get(verdict.id)
        seen = gate_result(registry, verdict)
        if stopped.outcome is not None:
            return report_of(registry, verdict, stopped.outcome, seen, (stopped.evidence or {}).get("note"))
        if seen.outcome is not None:
            break
    assert seen.outcome is not None, "a schedule ends with its test"
    refused = promote(registry, verdict, _reason(verdict, seen)) if seen.outcome == "promote" else seen.note
    return _close(registry, verdict, seen.outcome, seen, note=refused)


def void(registry: Registry, verdict: str, *, actor: str, reason: str, purge: bool = False) -> VerdictRow:
    """Stop an open verdict or revoke a closed one. Its α stays spent, because its results may be the reason for voiding
       it.

    The candidate is gated again with other games. A promotion that resulted from the verdict stays.
    purge: exclude its games, which stay in the ledger, from all results.
    Raises NotFound, or Conflict for a verdict whose promotion is just being applied.
    """
    row = registry.verdicts.void(verdict, f"voided by {actor}: {reason}")
    if purge:
        Ledger(registry).purge(schedules_of(row))
    return row


def schedules_of(verdict: VerdictRow) -> list[str]:
    """Ids of the schedules that belong to a verdict."""
    confirmation = verdict.settings.get("confirmation")
    return [*tested_schedules(verdict), *([confirmation] if confirmation else [])]


def tested_schedules(verdict: VerdictRow) -> list[str]:
    """Ids of the schedules whose results decide a verdict, in order."""
    settings = verdict.settings
    companions = [*settings.get("anchors", ()), *settings.get("exploiters", ())]
    return [verdict.schedule, *(each["schedule"] for each in companions)]


def _tests(registry: Registry, verdict: VerdictRow) -> list[tuple[Schedule, SequentialMonitor]]:
    """The schedules of a verdict in order, each with a monitor of its test."""
    gate, candidate, settings = gate_of(verdict), _candidate_ref(verdict), verdict.settings
    anchors = [gate.against_anchor(each["margin"]) for each in settings.get("anchors", ())]
    exploiters = [gate.against_exploiter(each["margin"]) for each in settings.get("exploiters", ())]
    monitors = [SequentialMonitor(each, candidate) for each in (gate, *anchors)]
    monitors += [SequentialMonitor(each, candidate, verdict.champion) for each in exploiters]
    schedules = map(Ledger(registry).schedule, tested_schedules(verdict))
    return list(zip(schedules, monitors, strict=True))


def _play(
    registry: Registry,
    verdict: VerdictRow,
    schedule: Schedule,
    watch: SequentialMonitor,
    workers: int,
    listener: Listener | None,
) -> None:
    """Play one of its tests until it is decided or the verdict is closed by another process."""

    def report(progress: Progress | VerdictReport) -> None:
        if listener and isinstance(progress, Progress):
            listener(replace(progress, llr=watch.llr, bounds=watch.bounds))

    def enough(matches: Sequence[Match]) -> bool:
        return watch.is_over(matches) or registry.verdicts.get(verdict.id).outcome is not None

    tournament.play_schedule(schedule, registry=registry, workers=workers, enough=enough, listener=report)


def _obstacle(registry: Registry, verdict: VerdictRow) -> str | None:
    """Why this verdict cannot continue: the champion or the environment has changed, or its promotion is impossible."""
    if is_applied(registry, verdict):
        return None
    now = registry.aliases.current(verdict.league).get(CHAMPION)
    if now != tested_champion(verdict):
        holder = "there is no champion" if now is None else f"the champion is {verdict.league}@{now}"
        return f"{holder} now, but the test was against {verdict.champion}"
    then, current = _schedule(registry, verdict).conditions, registry.leagues.get(verdict.league).conditions
    if then.game_digest != current.game_digest:
        return "the league's game has changed"
    if then.actions != current.actions:
        return f"the league plays with {current.actions} actions now, but the test was with {then.actions} ones"
    return None if now is None else _below_floor(registry, verdict, now)


def _below_floor(registry: Registry, verdict: VerdictRow, champion: int) -> str | None:
    """Why the candidate is not tested: insufficient results as the champion's shadow."""
    for shadowing in registry.traffic.shadow_counts(verdict.league):
        if (shadowing.candidate, shadowing.champion) == (verdict.candidate, champion):
            latency = shadowing.milliseconds(0.95)
            seen = shadowing.observations, shadowing.failed, shadowing.agreement
            return shadow_shortfall(gate_of(verdict), *seen, latency)
    return shadow_shortfall(gate_of(verdict), 0, 0, None, None)


def _schedule(registry: Registry, verdict: VerdictRow) -> Schedule:
    return Ledger(registry).schedule(verdict.schedule)


def gate_of(verdict: VerdictRow) -> GateConfig:
    """The gate's settings when the verdict was opened, including its α."""
    return GateConfig.model_validate(verdict.settings["gate"])


def _candidate_ref(verdict: VerdictRow) -> str:
    return f"{verdict.league}@{verdict.candidate}"


def gate_statistics(decision: Decision) -> dict[str, Any]:
    """The fields of a report that describe a sequential test. Infinite bounds are None."""
    estimate = decision.estimate
    return {
        "llr": decision.llr,
        "bounds": decision.bounds,
        "blocks": decision.blocks,
        "games": decision.games,
        "unique_games": decision.unique_games or 0,
        "counts": decision.counts,
        "score": decision.score,
        "elo": estimate and _finite(estimate.elo),
        "interval": estimate and (_finite(estimate.low), _finite(estimate.high)),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _matches(registry: Registry, verdict: VerdictRow, schedule: str | None = None) -> Sequence[Match]:
    return Ledger(registry).matches(league=verdict.league, schedule=schedule or verdict.schedule)


def gate_result(registry: Registry, verdict: VerdictRow) -> GateResult:
    """Compute the gate result of a verdict from the ledger."""
    gate, candidate_ref = gate_of(verdict), _candidate_ref(verdict)
    matches = _matches(registry, verdict)
    champion = decide_matches(gate, matches, candidate_ref)
    forfeited = forfeits(matches[: champion.blocks], candidate_ref)
    companions: list[CompanionResult] = []
    for anchor in verdict.settings.get("anchors", ()):
        ref, margin, schedule = anchor["ref"], anchor["margin"], anchor["schedule"]
        matches = _matches(registry, verdict, schedule)
        decision = decide_matches(gate.against_anchor(margin), matches, candidate_ref)
        companions.append(AnchorResult(ref, margin, schedule, decision))
        forfeited += forfeits(matches[: decision.blocks], candidate_ref)
    for exploiter in verdict.settings.get("exploiters", ()):
        matches = _matches(registry, verdict, exploiter["schedule"])
        result = exploiter_result(gate, matches, candidate_ref, verdict.champion, exploiter)
        companions.append(result)
        forfeited += forfeits(matches[: 2 * result.decision.blocks], candidate_ref)
    return combine_results(champion, companions, len(companions), None if gate.forfeits else forfeited)


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
    if _schedule(registry, verdict).scoring == "game" and gate_of(verdict).model != "returns":
        return None
    return paired_difference(_matches(registry, verdict, name)[:blocks], _candidate_ref(verdict))


def _reason(verdict: VerdictRow, seen: GateResult) -> str:
    decision = seen.champion
    anchors = f", and is not inferior to {', '.join(each.ref for each in seen.anchors)}" if seen.anchors else ""
    exploiters = ", ".join(each.ref for each in seen.exploiters)
    unexploited = f", and does no worse than it against {exploiters}" if exploiters else ""
    return (
        f"beat {verdict.champion} over {decision.games} games: score {decision.score:.3f},"
        f" LLR {decision.llr:.2f} of {decision.bounds[1]:.2f}{anchors}{unexploited}"
    )


def _close(registry: Registry, verdict: VerdictRow, outcome: str, seen: GateResult, note: str | None) -> VerdictReport:
    report = report_of(registry, verdict, outcome, seen, note)
    registry.verdicts.close(verdict.id, outcome, report.to_json())
    return report


def report_of(
    registry: Registry, verdict: VerdictRow, outcome: str, seen: GateResult, note: str | None
) -> VerdictReport:
    """Report of a verdict that ends with this gate result."""
    return VerdictReport(
        verdict=verdict.id,
        candidate=_candidate_ref(verdict),
        opponent=verdict.champion,
        outcome=outcome,
        **gate_statistics(seen.champion),
        promoted=is_applied(registry, verdict),
        alpha=verdict.alpha,
        anchors=tuple(map(anchor_report, seen.anchors)),
        exploiters=tuple(map(exploiter_report, seen.exploiters)),
        difference=difference_of_returns(registry, verdict, seen.champion.blocks),
        note=note,
    )


OUTCOMES = {"promote": "not inferior", "reject": "inferior", "inconclusive": "inconclusive", None: "open"}


def anchor_report(anchor: AnchorResult) -> AnchorReport:
    """Report of one non-inferiority test."""
    return AnchorReport(
        ref=anchor.ref,
        margin=anchor.margin,
        schedule=anchor.schedule,
        outcome=OUTCOMES[anchor.decision.outcome],
        **gate_statistics(anchor.decision),
    )


PAIRED_OUTCOMES = OUTCOMES | {"promote": "not worse", "reject": "worse"}


def exploiter_report(exploiter: ExploiterResult) -> ExploiterReport:
    """Report of one paired test against an exploiter."""
    statistics = gate_statistics(exploiter.decision)
    own, champion = exploiter.scores or (None, None)
    return ExploiterReport(
        ref=exploiter.ref,
        exploits=exploiter.exploits,
        margin=exploiter.margin,
        schedule=exploiter.schedule,
        outcome=PAIRED_OUTCOMES[exploiter.decision.outcome],
        **{name: statistics[name] for name in ("llr", "bounds", "blocks", "games", "unique_games", "counts")},
        score=own,
        champion_score=champion,
        difference=exploiter.difference,
    )


def confirm(
    registry: Registry, verdict: VerdictRow, *, workers: int = 0, listener: Listener | None = None
) -> Confirmation | None:
    """Play the confirmation match of a promotion to its end and return the measured improvement.

    None if nothing was promoted, no confirmation is configured, or the league's conditions have changed.
    """
    schedule = verdict.settings.get("confirmation")
    if verdict.outcome != "promote" or not is_effective(verdict) or schedule is None:
        return None
    whole = Ledger(registry).schedule(schedule)
    if whole.conditions != registry.leagues.get(verdict.league).conditions:
        return None
    tournament.play_schedule(whole, registry=registry, workers=workers, listener=listener)
    return confirmation(registry, verdict)


def confirmation(registry: Registry, verdict: VerdictRow) -> Confirmation | None:
    """Improvement of a promotion measured by its confirmation match; None until that is complete.

    The match has a fixed length and no influence on the decision, so the estimate is unbiased. The estimate of the
    verdict itself is optimistic, because the test stopped when the results looked good.
    """
    name = verdict.settings.get("confirmation")
    if name is None:
        return None
    schedule, matches = Ledger(registry).schedule(name), _matches(registry, verdict, name)
    if len(matches) < schedule.length:
        return None
    counts = cell_counts(matches, _candidate_ref(verdict))
    estimate = elo_estimate(counts, "logistic")
    return Confirmation(
        verdict=verdict.id,
        candidate=_candidate_ref(verdict),
        opponent=verdict.champion,
        games=2 * len(matches),
        score=sum(i * n for i, n in enumerate(counts)) / (len(counts) - 1) / len(matches),
        elo=estimate.elo,
        interval=(estimate.low, estimate.high),
        difference=difference_of_returns(registry, verdict, name=name),
    )
