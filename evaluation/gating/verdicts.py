"""A verdict from its opening to the promotion. The process may be killed at any point; another one resumes.

schedules in the ledger → verdict opened → matches → gate result → champion moved → verdict closed

The order makes every step repeatable. An open verdict has its schedules: against the champion, against each anchor and
each exploiter, and for the confirmation match of a promotion. The gate result follows from the matches in the ledger.
The test of exploitability is recorded once the exploiters of candidate and champion are trained.
The champion moves while the verdict is still open, and the audit row names the verdict. A verdict that was interrupted
there is closed and never applied twice, even if the champion was rolled back meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from evaluation.gating.gate import SequentialMonitor, shadow_shortfall
from evaluation.gating.gate_result import AnchorResult, GateResult, PairedResult
from evaluation.gating.opponents import recent_exploiters, resolve_anchors
from evaluation.gating.sequential_tests import SequentialTest, sequential_test
from evaluation.gating.trained_exploiters import Trainer, prepared_test
from evaluation.gating.verdict_report import confirmation, gate_of, gate_result, is_applied, report_of
from evaluation.matches import tournament
from evaluation.results import Confirmation, Listener, Progress, VerdictReport
from evaluation.schedules.builders import companion, paired_test
from evaluation.schedules.builders import verdict as verdict_schedule
from league.config.gate import GateConfig
from league.errors import AliasMoved
from league.histograms import Histogram
from league.refs import CHAMPION, CheckpointRef, RemoteRef, ScriptRef, parse_ref
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow, VerdictRow
from league.registry.verdicts import VOID
from league.results.ledger import Ledger
from league.results.records import Match, Schedule
from league.verdict_tests import AnchorTest, CompanionTest, CompanionTests, ExploiterTest

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
    config, candidate_ref, ledger = league.config, f"{league.slug}@{candidate}", Ledger(registry)
    gate = config.gate if _is_version(opponent) else config.gate.against_baseline()
    gate = gate.of_one_verdict(gate.alpha if alpha is None else alpha)
    schedule = verdict_schedule(config, league.interface, candidate_ref, opponent, gate, seed=len(earlier))
    ledger.open(schedule)
    tests = _opened_tests(registry, league, candidate, schedule, gate)
    settings = {"gate": gate.model_dump(mode="json"), "night": nightly_run} | tests.to_settings()
    return registry.verdicts.open(league.slug, candidate, opponent, schedule.id, settings)


def _is_version(opponent: str) -> bool:
    return isinstance(parse_ref(opponent), CheckpointRef)


def _opened_tests(
    registry: Registry, league: LeagueRow, candidate: int, schedule: Schedule, gate: GateConfig
) -> CompanionTests:
    """Choose the tests of a verdict after that against the champion, and open their schedules."""
    config, interface, ledger = league.config, league.interface, Ledger(registry)
    opponent = schedule.contestants[1]
    anchors, exploiters, confirmation = list[AnchorTest](), list[ExploiterTest](), None
    for anchor in resolve_anchors(registry, league, candidate, opponent):
        mode = anchor.tested_mode
        play = companion if mode == "at_least" else paired_test
        test_schedule = play(config, interface, "anchor", schedule, anchor.ref, gate.max_blocks)
        anchors.append(AnchorTest(anchor.ref, gate.margin_of(anchor), ledger.open(test_schedule).id, mode))
    for exploiter in recent_exploiters(registry, league, opponent):
        assert exploiter.exploits is not None, "it is an exploiter"
        test_schedule = paired_test(config, interface, "exploiter", schedule, exploiter.ref, gate.max_blocks)
        margin = gate.margin_against_exploiters
        exploiters.append(ExploiterTest(exploiter.ref, exploiter.exploits, margin, ledger.open(test_schedule).id))
    if gate.confirmation_blocks:
        test_schedule = companion(config, interface, "confirmation", schedule, opponent, gate.confirmation_blocks)
        confirmation = ledger.open(test_schedule).id
    return CompanionTests(
        anchors=tuple(anchors),
        exploiters=tuple(exploiters),
        awaits_exploiters=bool(gate.exploiters.count) and _is_version(opponent) and len(interface.sides) > 1,
        confirmation=confirmation,
    )


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
    if (obstacle := _obstacle(registry, verdict)) is not None:
        return _close(registry, verdict, VOID, gate_result(registry, verdict), note=obstacle)
    for schedule, watch in _tests(registry, verdict, train):
        _play(registry, verdict, schedule, watch, workers, listener)
        if registry.verdicts.get(verdict.id).outcome is not None or gate_result(registry, verdict).outcome is not None:
            break
    verdict = registry.verdicts.get(verdict.id)
    result = gate_result(registry, verdict)
    if verdict.outcome is not None:
        return report_of(registry, verdict, verdict.outcome, result, (verdict.evidence or {}).get("note"))
    if is_applied(registry, verdict):
        obstacle = None
    elif result.outcome == "promote":
        obstacle = _changed_conditions(registry, verdict)  # `promote` finds out whether the champion has moved
    else:
        obstacle = _obstacle(registry, verdict)
    if obstacle is not None:
        return _close(registry, verdict, VOID, result, note=obstacle)
    assert result.outcome is not None, "a schedule ends with its test"
    refused = promote(registry, verdict, _reason(verdict, result)) if result.outcome == "promote" else result.note
    return _close(registry, verdict, result.outcome, result, note=refused)


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


def _tests(
    registry: Registry, verdict: VerdictRow, train: Trainer | None
) -> Iterator[tuple[Schedule, SequentialMonitor]]:
    """The schedules of a verdict in order, each with a monitor of its test.

    Before the last one, the exploiters that it needs are trained. It is left out if the verdict is closed meanwhile, or
    cannot continue.
    """
    gate, candidate, companions, ledger = gate_of(verdict), verdict.candidate_ref, verdict.companions, Ledger(registry)

    def monitored(test: CompanionTest) -> tuple[Schedule, SequentialMonitor]:
        sequential = sequential_test(gate, test, candidate, verdict.champion)
        return ledger.schedule(test.schedule), SequentialMonitor(sequential)

    yield ledger.schedule(verdict.schedule), SequentialMonitor(SequentialTest(gate, candidate))
    for anchor in companions.anchors:
        yield monitored(anchor)
    for exploiter in companions.exploiters:
        yield monitored(exploiter)
    if not companions.includes_exploitability or _obstacle(registry, verdict) is not None:
        return
    if (test := prepared_test(registry, verdict, train)) is not None:
        yield monitored(test)


def _play(
    registry: Registry,
    verdict: VerdictRow,
    schedule: Schedule,
    watch: SequentialMonitor,
    workers: int | None,
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
    champion = registry.aliases.current(verdict.league).get(CHAMPION)
    if champion != tested_champion(verdict):
        holder = "there is no champion" if champion is None else f"the champion is {verdict.league}@{champion}"
        return f"{holder} now, but the test was against {verdict.champion}"
    if (changed := _changed_conditions(registry, verdict)) is not None:
        return changed
    return None if champion is None else _below_floor(registry, verdict, champion)


def _changed_conditions(registry: Registry, verdict: VerdictRow) -> str | None:
    """Why the games of this verdict do not count any more: the league's game or selection of actions has changed."""
    tested_conditions = Ledger(registry).schedule(verdict.schedule).conditions
    current_conditions = registry.leagues.get(verdict.league).conditions
    if tested_conditions.game_digest != current_conditions.game_digest:
        return "the league's game has changed"
    if tested_conditions.actions != current_conditions.actions:
        return (
            f"the league plays with {current_conditions.actions} actions now,"
            f" but the test was with {tested_conditions.actions} ones"
        )
    return None


def _below_floor(registry: Registry, verdict: VerdictRow, champion: int) -> str | None:
    """Why the candidate is not tested: insufficient results as the champion's shadow.

    Replicas count for the members of a mixture.
    """
    mixtures = registry.versions.mixtures(verdict.league, [verdict.candidate, champion])
    candidates, champions = (
        mixtures[number].versions if number in mixtures else (number,) for number in (verdict.candidate, champion)
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
    return shadow_shortfall(gate_of(verdict), observations, failed, agreement, latency.quantile(0.95))


def _reason(verdict: VerdictRow, seen: GateResult) -> str:
    decision = seen.champion
    strong = ", ".join(test_result.test.ref for test_result in seen.companions if isinstance(test_result, AnchorResult))
    paired = ", ".join(test_result.test.ref for test_result in seen.companions if isinstance(test_result, PairedResult))
    anchors = f", and is not inferior to {strong}" if strong else ""
    no_worse = f", and does no worse than it against {paired}" if paired else ""
    exploitability = ""
    if (result := seen.exploitability) is not None:
        exploitability = (
            f", and is {'less' if result.test.improvement else 'not more'} exploitable by its own exploiters"
        )
    comparison = "beat" if gate_of(verdict).requires_gain else "is not inferior to"
    return (
        f"{comparison} {verdict.champion} over {decision.games} games: score {decision.score:.3f},"
        f" LLR {decision.llr:.2f} of {decision.bounds[1]:.2f}{anchors}{no_worse}{exploitability}"
    )


def _close(registry: Registry, verdict: VerdictRow, outcome: str, seen: GateResult, note: str | None) -> VerdictReport:
    report = report_of(registry, verdict, outcome, seen, note)
    registry.verdicts.close(verdict.id, outcome, report.to_json())
    return report


def confirm(
    registry: Registry, verdict: VerdictRow, *, workers: int | None = 0, listener: Listener | None = None
) -> Confirmation | None:
    """Play the confirmation match of a promotion to its end and return the measured improvement.

    None if nothing was promoted, no confirmation is configured, or the league's conditions have changed.
    """
    schedule = verdict.companions.confirmation
    if verdict.outcome != "promote" or not is_effective(verdict) or schedule is None:
        return None
    whole = Ledger(registry).schedule(schedule)
    if whole.conditions != registry.leagues.get(verdict.league).conditions:
        return None
    tournament.play_schedule(whole, registry=registry, workers=workers, listener=listener)
    return confirmation(registry, verdict)
