"""A verdict from its opening to the promotion. The process may be killed at any point; another one resumes.

schedules in the ledger → verdict opened → matches → gate result → champion moved → verdict closed

The order makes every step repeatable. An open verdict has its schedules: against the champion, against each anchor and
each exploiter, and for the confirmation match of a promotion. The gate result follows from the matches in the ledger.
The test of exploitability is recorded once the exploiters of candidate and champion are trained.
The champion moves while the verdict is still open, and the audit row names the verdict. A verdict that was interrupted
there is closed and never applied twice, even if the champion was rolled back meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from evaluation.documents import Listener, Progress
from evaluation.gating.criteria.criterion import Contest, Criterion
from evaluation.gating.evidence import (
    CRITERIA,
    Confirmation,
    VerdictReport,
    confirmation,
    evidence,
    gate_result,
    is_applied,
    verdict_of,
)
from evaluation.gating.gate import SequentialMonitor, shadow_shortfall
from evaluation.gating.gate_result import GateResult
from evaluation.gating.trained_exploiters import Trainer
from evaluation.matches import tournament
from evaluation.schedules.builders import companion
from evaluation.schedules.builders import verdict as verdict_schedule
from league.errors import AliasMoved
from league.histograms import Histogram
from league.refs import CHAMPION, CheckpointRef, RemoteRef, ScriptRef, parse_ref
from league.registry.registry import Registry
from league.registry.storage.manifest import Mixture
from league.registry.storage.rows import LeagueRow, VerdictRow
from league.registry.verdicts import VOID
from league.results.ledger import Ledger
from league.results.records import Match

ACTOR = "league nightly"


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
    earlier = [
        row for row in registry.verdicts.all(league.slug) if (row.candidate, row.champion) == (candidate, opponent)
    ]
    if (resumed := next((row for row in earlier if row.outcome is None), None)) is not None:
        return resumed
    config, interface, ledger = league.config, league.interface, Ledger(registry)
    gate = config.gate if isinstance(parse_ref(opponent), CheckpointRef) else config.gate.against_baseline()
    gate = gate.of_one_verdict(gate.alpha if alpha is None else alpha)
    schedule = verdict_schedule(config, interface, f"{league.slug}@{candidate}", opponent, gate, seed=len(earlier))
    tests = [test for kind in CRITERIA for test in kind.planned(registry, league, schedule, gate)]
    schedules = [test_schedule for _, test_schedule in tests]
    settings: dict[str, Any] = {
        "gate": gate.model_dump(mode="json"),
        "night": nightly_run,
        "tests": [test.to_record() for test, _ in tests[1:]],
    }
    if gate.confirmation_blocks:
        match = companion(config, interface, "confirmation", schedule, opponent, gate.confirmation_blocks)
        settings["confirmation"] = match.id
        schedules.append(match)
    for opened in filter(None, schedules):
        ledger.open(opened)
    return registry.verdicts.open(league.slug, candidate, opponent, schedule.id, settings)


def conclude(
    registry: Registry,
    verdict: VerdictRow,
    *,
    train: Trainer | None = None,
    workers: int | None = 0,
    listener: Listener | None = None,
) -> VerdictReport:
    """Play an open verdict to its end, promote the candidate if it passes all tests, and close the verdict.

    A verdict that a person voids meanwhile ends immediately. If the champion changes meanwhile, it is void, so that the
    candidate is tested against the new one.

    Args:
        registry: The registry of the verdict.
        verdict: The verdict.
        train: Trains the exploiters that `gate.exploiters` requires. Without it, a verdict that needs them stays open.
        workers: Parallel Ray tasks, as in `play_schedule`.
        listener: Receives progress.

    Raises:
        ExploiterMissing: An exploiter was not trained. The next call tries again.
        AlreadyRunning: Another process trains an exploiter of this verdict.
        LeagueError: The errors of `play_schedule`.
    """
    contest = Contest.of(registry, verdict)
    if (obstacle := _obstacle(contest)) is not None:
        return _close(contest, gate_result(contest), VOID, obstacle)
    result = gate_result(contest, partial(_play, contest, train, workers, listener))
    if (row := registry.verdicts.get(verdict.id)).outcome is not None:
        return verdict_of(registry, row)
    # `promote` finds out whether the champion has moved.
    outcome = result.outcome
    obstacle = _changed_conditions(contest) if outcome == "promote" else _obstacle(contest)
    if obstacle is not None and not is_applied(registry, verdict):
        return _close(contest, result, VOID, obstacle)
    assert outcome is not None, "a schedule ends with its test"
    refused = promote(registry, verdict, _reason(contest, result)) if outcome == "promote" else result.note
    return _close(contest, result, outcome, refused)


def void(registry: Registry, verdict: str, *, actor: str, reason: str, purge: bool = False) -> VerdictRow:
    """Stop an open verdict or revoke a closed one.

    Its α stays spent, because its results may be the reason for voiding it. The candidate is tested again with other
    games. A promotion that resulted from the verdict stays.
    verdict: its id, or a unique beginning of it or of its digest.
    purge: exclude its games, which stay in the ledger, from all results.
    Raises NotFound, or Conflict for a verdict whose promotion is just being applied.
    """
    row = registry.verdicts.void(registry.verdicts.find(verdict).id, f"voided by {actor}: {reason}")
    if purge:
        Ledger(registry).purge(row.schedules)
    return row


def _play(
    contest: Contest, train: Trainer | None, workers: int | None, listener: Listener | None, test: Criterion
) -> Criterion | None:
    """Play a test until it is decided or the verdict is closed by another process.

    Opponents that it needs are trained before.

    Returns:
        The test; None if the verdict was closed meanwhile, or cannot continue.
    """
    registry, verdict = contest.registry, contest.verdict.id

    def is_closed() -> bool:
        return registry.verdicts.get(verdict).outcome is not None

    if test.schedule != verdict and is_closed():
        return None
    if test.schedule is None:
        prepared = None if _obstacle(contest) is not None else test.prepared(contest, train)
        if prepared is None or prepared.schedule is None:
            return None
        test = prepared
    assert test.schedule is not None, "its opponents are trained"
    schedule, monitor = contest.ledger.schedule(test.schedule), SequentialMonitor(test.sequential(contest))

    def report(progress: Progress) -> None:
        if listener:
            listener(replace(progress, llr=monitor.llr, bounds=monitor.bounds))

    def enough(matches: Sequence[Match]) -> bool:
        return monitor.is_over(matches) or is_closed()

    tournament.play_schedule(schedule, registry=registry, workers=workers, enough=enough, listener=report)
    return test


def _obstacle(contest: Contest) -> str | None:
    """Why a verdict cannot continue: the champion or the environment has changed, or its promotion is impossible."""
    registry, verdict = contest.registry, contest.verdict
    if is_applied(registry, verdict):
        return None
    champion = registry.aliases.current(verdict.league).get(CHAMPION)
    if champion != tested_champion(verdict):
        holder = "there is no champion" if champion is None else f"the champion is {verdict.league}@{champion}"
        return f"{holder} now, but the test was against {verdict.champion}"
    if (changed := _changed_conditions(contest)) is not None:
        return changed
    return None if champion is None else _below_floor(contest, champion)


def _changed_conditions(contest: Contest) -> str | None:
    """Why the games of this verdict do not count any more: the league's game or selection of actions has changed."""
    tested = contest.schedule.conditions
    current = contest.registry.leagues.get(contest.verdict.league).conditions
    if tested.game_digest != current.game_digest:
        return "the league's game has changed"
    if tested.actions != current.actions:
        return f"the league plays with {current.actions} actions now, but the test was with {tested.actions} ones"
    return None


def _below_floor(contest: Contest, champion: int) -> str | None:
    """Why the candidate is not tested: insufficient results as the champion's shadow.

    Replicas count for the members of a mixture.
    """
    registry, verdict = contest.registry, contest.verdict
    compositions = registry.versions.compositions(verdict.league, [verdict.candidate, champion])
    candidates, champions = (
        one.versions if isinstance(one := compositions.get(number), Mixture) else (number,)
        for number in (verdict.candidate, champion)
    )
    shadow_counts = [
        counts
        for counts in registry.traffic.shadow_counts(verdict.league)
        if counts.candidate in candidates and counts.champion in champions
    ]
    observations = sum(counts.observations for counts in shadow_counts)
    agreement = sum(counts.agreed for counts in shadow_counts) / observations if observations else None
    latency = Histogram()
    for counts in shadow_counts:
        latency.merge(counts.latency, counts.ns)
    failed = sum(counts.failed for counts in shadow_counts)
    return shadow_shortfall(contest.gate, observations, failed, agreement, latency.quantile(0.95))


def _reason(contest: Contest, result: GateResult) -> str:
    decision = result.champion.decision
    comparison = "beat" if contest.gate.requires_gain else "is not inferior to"
    further = "".join(f", and {test.passed}" for test in result.further)
    return (
        f"{comparison} {contest.champion} over {decision.games} games: score {decision.score:.3f},"
        f" LLR {decision.llr:.2f} of {decision.bounds[1]:.2f}{further}"
    )


def _close(contest: Contest, result: GateResult, outcome: str, note: str | None) -> VerdictReport:
    closed = evidence(contest, result, outcome, note)
    contest.registry.verdicts.close(contest.verdict.id, outcome, closed.to_record())
    return closed


def confirm(
    registry: Registry, verdict: VerdictRow, *, workers: int | None = 0, listener: Listener | None = None
) -> Confirmation | None:
    """Play the confirmation match of a promotion to its end and return the measured improvement.

    None if nothing was promoted, no confirmation is configured, or the league's conditions have changed.
    """
    schedule = verdict.confirmation
    if verdict.outcome != "promote" or not is_effective(verdict) or schedule is None:
        return None
    whole = Ledger(registry).schedule(schedule)
    if whole.conditions != registry.leagues.get(verdict.league).conditions:
        return None
    tournament.play_schedule(whole, registry=registry, workers=workers, listener=listener)
    return confirmation(Contest.of(registry, verdict))
