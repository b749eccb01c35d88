"""Why a verdict has its outcome and what would change it, in sentences for commands, reports, web pages and HTTP."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from evaluation.gating.gate import Decision
from evaluation.gating.gate_result import (
    AnchorResult,
    CompanionResult,
    ExploitabilityResult,
    GateResult,
    PairedResult,
)
from evaluation.statistics.sequential import score_at
from league.config.gate import GateConfig
from league.refs import CheckpointRef, parse_ref
from league.registry.storage.rows import VerdictRow
from league.registry.verdicts import VOID
from league.results.records import Match
from league.verdict_tests import AnchorTest, ExploitabilityTest

MOST_GAMES = 1_000_000
"""Games beyond which an estimate of those that a test needs is of no use."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Why a verdict has its outcome.

    reason: what decided, and the scores of candidate and champion in the tests. remedy: what would have to change for a
    promotion; None after one, and while the verdict is open.
    """

    reason: str
    remedy: str | None


def explain(
    verdict: VerdictRow,
    gate: GateConfig,
    seen: GateResult,
    *,
    outcome: str | None,
    promoted: bool,
    note: str | None,
    champion_scores: Mapping[str, float],
) -> Explanation:
    """Explain a verdict.

    Args:
        verdict: The verdict.
        gate: Its settings.
        seen: What its games show.
        outcome: Its outcome; None while it is open.
        promoted: Whether it made the candidate champion.
        note: Why it is void, or was not applied.
        champion_scores: Anchor → mean score of the champion against it in other games.
    """
    failed = next(
        (companion for companion in seen.companions if companion.decision.outcome in ("reject", "inconclusive")), None
    )
    scores = _scores(verdict, seen, champion_scores)
    reason = " ".join((_finding(gate, seen, outcome, promoted, note), *scores))
    return Explanation(reason, _remedy(verdict, gate, seen, failed, outcome, promoted))


def _finding(gate: GateConfig, seen: GateResult, outcome: str | None, promoted: bool, note: str | None) -> str:
    """What decided."""
    decision, note = seen.champion, note if outcome in (VOID, "promote") else seen.note or note
    passed, failed = ("Stronger", "Not stronger") if gate.requires_gain else ("Not inferior", "Inferior")
    llr, lower, upper = (_signed(value) for value in (decision.llr, *decision.bounds))
    after = f"after {decision.games} games, the LLR was {llr}"
    match outcome:
        case None if decision.outcome == "promote":
            return f"Undecided: {seen.shown}, and further tests are under way."
        case None:
            return f"Undecided: {after}, between {lower} and {upper}."
        case "promote" if promoted:
            return f"{passed}: {after}, above the bound of {upper}."
        case "promote":
            return f"{passed} ({after}), but not promoted: {note or 'no reason was recorded'}."
        case "inconclusive" if note is None:
            return f"Inconclusive: {after}, between {lower} and {upper}, at the maximum number of games."
        case "reject" if note is None:
            return f"{failed}: {after}, below the bound of {lower}."
    return f"{'Rejected' if outcome == 'reject' else outcome.capitalize()}: {note or after}."


def _scores(verdict: VerdictRow, seen: GateResult, champion_scores: Mapping[str, float]) -> list[str]:
    """Scores of candidate and champion in each test that was played."""
    champion, decision = verdict.champion, seen.champion
    if decision.score is None:
        return []
    scores = [f"It scored {percent(decision.score)} against {champion}, which scored {percent(1 - decision.score)}."]
    for companion in seen.companions:
        match companion:
            case AnchorResult(test=test, decision=Decision(score=float(score), games=games)):
                its = champion_scores.get(test.ref)
                comparison = (
                    f"{champion} has not played it" if its is None else f"{champion} {percent(its)} in other games"
                )
                scores.append(f"Against {test.ref} it scored {percent(score)} in {games} games; {comparison}.")
            case PairedResult(test=test, scores=(candidate_score, its)):
                scores.append(
                    f"Against {test.ref} it scored {percent(candidate_score)}, and {champion} {percent(its)}."
                )
            case ExploitabilityResult(sample=sample) if sample:
                candidate_score, champion_score = (
                    _mean_score(sample, ref) for ref in (verdict.candidate_ref, champion)
                )
                scores.append(
                    f"Against its exploiters it scored {percent(candidate_score)},"
                    f" and {champion} {percent(champion_score)}."
                )
    return scores


def _mean_score(matches: Sequence[Match], ref: str) -> float:
    scores = [match.score(match.contestants.index(ref)) for match in matches if ref in match.contestants]
    return sum(scores) / len(scores)


def _remedy(
    verdict: VerdictRow,
    gate: GateConfig,
    seen: GateResult,
    failed: CompanionResult | None,
    outcome: str | None,
    promoted: bool,
) -> str | None:
    """What would have to change for a promotion."""
    if outcome is None or promoted:
        return None
    if outcome in (VOID, "promote"):
        return "The next nightly run tests it again, on other games."
    if seen.champion.outcome == "promote" and seen.forfeits:
        return "It must return a legal action in each game. With gate.forfeits: true, forfeits are only lost games."
    if failed is None:
        requirement, decision = _wanted_of_champion(verdict, gate, seen.champion), seen.champion
        hypotheses = "gate.return0 and gate.return1" if gate.model == "returns" else "gate.elo0 and gate.elo1"
        wider = f"{hypotheses} that are further apart"
    else:
        requirement, decision = _wanted(gate, failed), failed.decision
        wider = f"a larger {_setting(failed)}"
    if outcome == "inconclusive" and decision.blocks:
        return f"{requirement} {_more_games(gate, decision, wider)}"
    return requirement


def _wanted_of_champion(verdict: VerdictRow, gate: GateConfig, decision: Decision) -> str:
    opponent = verdict.champion
    if gate.model == "returns":
        bar = (gate.return0 + gate.return1) / 2
        return f"To pass, its returns must exceed those of {opponent} by more than about {bar:g} on average."
    bar = score_at((gate.elo0 + gate.elo1) / 2, decision.counts, gate.model)
    return (
        f"To pass, it must score more than about {percent(bar)} against {opponent}"
        f" (gate.elo0: {gate.elo0:g}, gate.elo1: {gate.elo1:g})."
    )


def _wanted(gate: GateConfig, failed: CompanionResult) -> str:
    """What passes a test: more than about the middle between its hypotheses."""
    margin, unit, hint = failed.test.margin, "in returns" if gate.model == "returns" else "of all points", ""
    match failed:
        case AnchorResult(test=test, decision=decision):
            if gate.model == "returns":
                bar = f"its returns may be at most about {margin / 2:g} below those of {test.ref}"
            else:
                bar = f"it must score more than about {percent(score_at(-margin / 2, decision.counts, gate.model))}"
                bar += f" against {test.ref}"
            if not isinstance(parse_ref(test.ref), CheckpointRef):
                hint = " With mode: no_worse, it need only do as well as the champion there."
        case PairedResult(test=test, champion=champion, scores=scores):
            bar = f"it may do at most about {margin / 2:g} {unit} worse against {test.ref} than {champion}"
            if gate.model != "returns" and scores is not None:
                bar = f"it must score more than about {percent(max(scores[1] - margin / 2, 0))} against {test.ref}"
        case ExploitabilityResult(test=test, champion=champion):
            limit = f"at least about {test.improvement / 2:g}" if test.improvement else f"at most about {margin / 2:g}"
            bar = f"exploiters may achieve {limit} {unit} more against it than against {champion}"
            if test.improvement:
                bar = f"exploiters must achieve {limit} {unit} less against it than against {champion}"
    return f"To pass, {bar} ({_setting(failed)}).{hint}"


def _setting(failed: CompanionResult) -> str:
    """The setting and value that separates the hypotheses of a test."""
    match failed.test:
        case AnchorTest(margin=margin):
            return f"margin of the anchor: {margin:g}"
        case ExploitabilityTest(improvement=improvement) if improvement:
            return f"gate.exploiters.improvement: {improvement:g}"
    return f"gate.exploiter_margin: {failed.test.margin:g}"


def _more_games(gate: GateConfig, decision: Decision, wider: str) -> str:
    """What decides a test that was not decided by `gate.max_blocks`."""
    lower, upper = decision.bounds
    rate = decision.llr / decision.blocks
    blocks = math.inf if rate == 0 else (upper if rate > 0 else lower) / rate
    games = blocks * decision.games / decision.blocks
    if games > MOST_GAMES:
        return f"It is about halfway between the hypotheses, so that more games hardly help: set {wider}."
    number = _rounded(blocks)
    if rate < 0:
        return f"More games would rather reject it, after about {_rounded(games):,} games (gate.max_blocks: {number})."
    return (
        f"At this rate, it passes after about {_rounded(games):,} games (gate.max_blocks: {number}, now"
        f" {gate.max_blocks}); fewer with {wider}."
    )


def _rounded(number: float) -> int:
    """Two significant digits, rounded up."""
    unit = 10 ** max(int(math.log10(number)) - 1, 0)
    return math.ceil(number / unit) * unit


def percent(share: float) -> str:
    """`75.9 %`"""
    return f"{100 * share:.1f} %"


def _signed(value: float) -> str:
    return f"{value:.2f}".replace("-", "−")
