"""The test against an anchor: the candidate is not inferior to it, or does not do worse against it than the champion.

A candidate that beats the champion may lose to earlier champions. In a cycle such as rock, paper, scissors, beating
the current champion is not progress.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Self

from evaluation.documents import Difference
from evaluation.gating.criteria.criterion import (
    Contest,
    Criterion,
    elo_statistics,
    paired_result,
    percent,
    statistics,
    worded,
)
from evaluation.gating.former_champions import earlier_champions
from evaluation.gating.gate import Decision, SequentialTest, decide_matches
from evaluation.gating.gate_result import CriterionReport, CriterionResult
from evaluation.schedules.builders import companion, paired_test
from evaluation.statistics.sequential import score_at
from league.config.gate import AnchorConfig, AnchorMode, GateConfig
from league.errors import UnknownAlias
from league.policies.loading import check_eligible, pinned
from league.refs import CheckpointRef, of_league, parse_ref
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow
from league.results.records import Match, Schedule


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchorReport(CriterionReport):
    """A CriterionReport of a test against an anchor.

    mode: `at_least`: the margin is in the gate's unit, and the outcome `not inferior` or `inferior`. `no_worse`: all
    other fields are those of an ExploiterReport, and there is no Elo.
    """

    score: float | None
    elo: float | None = None
    interval: tuple[float | None, float | None] | None = None
    mode: AnchorMode
    champion_score: float | None = None
    difference: Difference | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchorTest(Criterion):
    """Whether the candidate is not inferior to an anchor, or to the champion against the anchor.

    Attributes:
        ref: The anchor.
        margin: By how much the candidate may be weaker, or do worse than the champion.
        mode: What the candidate is compared with: the anchor, or the champion's results against it.
    """

    kind: ClassVar[str] = "anchor"

    ref: str
    margin: float
    mode: AnchorMode

    @classmethod
    def planned(
        cls, registry: Registry, league: LeagueRow, verdict: Schedule, gate: GateConfig
    ) -> list[tuple[Self, Schedule | None]]:
        tests, config, interface = list[tuple[Self, Schedule | None]](), league.config, league.interface
        for anchor in resolve_anchors(registry, league, *verdict.contestants):
            mode, ref = anchor.tested_mode, anchor.ref
            schedule = (
                companion(config, interface, cls.kind, verdict, ref, gate.max_blocks)
                if mode == "at_least"
                else paired_test(config, interface, cls.kind, verdict, [(ref, ref)], gate.max_blocks)
            )
            tests.append((cls(ref=ref, margin=gate.margin_of(anchor), schedule=schedule.id, mode=mode), schedule))
        return tests

    def sequential(self, contest: Contest) -> SequentialTest:
        if self.mode == "at_least":
            return SequentialTest(contest.gate.against_anchor(self.margin), contest.candidate)
        return SequentialTest(contest.gate.compared_with_champion(self.margin), contest.candidate, contest.champion)

    def result(self, contest: Contest, matches: Sequence[Match]) -> CriterionResult:
        gate, ref, margin, setting = contest.gate, self.ref, self.margin, "margin of the anchor"
        if self.mode == "no_worse":
            report = partial(AnchorReport, mode=self.mode)
            return paired_result(
                self, contest, matches, ref=ref, opponent=ref, margin=margin, setting=setting, report=report
            )
        decision, least = decide_matches(self.sequential(contest), matches), None
        if gate.model == "returns":
            bar, unit = f"its returns may be at most about {margin / 2:g} below those of {ref}", "in returns"
        else:
            least = score_at(-margin / 2, decision.counts, gate.model)
            bar, unit = f"it must score more than about {percent(least, decision.score)} against {ref}", "Elo"
        is_version = isinstance(parse_ref(ref), CheckpointRef)
        hint = "" if is_version else " With mode: no_worse, it need only do as well as the champion there."
        outcome, finding = worded(decision, "not inferior", "inferior", f"to {ref} by {margin:g} {unit}", ref)
        return CriterionResult(
            decision=decision,
            report=AnchorReport(
                **statistics(decision),
                **elo_statistics(decision),
                ref=ref,
                margin=margin,
                schedule=str(self.schedule),
                outcome=outcome,
                finding=finding,
                mode=self.mode,
            ),
            passed=f"is at most {margin:g} weaker than {ref}",
            failed=f"is weaker than {ref}",
            scores=self._scores(contest, decision, least),
            requirement=f"To pass, {bar} ({setting}: {margin:g}).{hint}",
            wider=f"a larger {setting}: {margin:g}",
        )

    def _scores(self, contest: Contest, decision: Decision, least: float | None) -> str | None:
        """The score of the candidate, and that of the champion in all games under the verdict's conditions.

        least: what the candidate must score.
        """
        if decision.score is None:
            return None
        champion, league, conditions = contest.champion, contest.verdict.league, contest.schedule.conditions
        counted = contest.ledger.counted(league, conditions)
        sums = contest.ledger.sums(league, counted, between=(champion, self.ref))
        comparison = f"{champion} has not played it"
        for pair, of_pair in sums.items():
            score = of_pair.whole.points[pair.index(champion)] / of_pair.whole.played
            comparison = f"{champion} {percent(score)} in other games"
        scored = percent(decision.score, least)
        return f"Against {self.ref} it scored {scored} in {decision.games} games; {comparison}."


def resolve_anchors(registry: Registry, league: LeagueRow, candidate: str, champion: str) -> list[AnchorConfig]:
    """Resolve the anchors of a new verdict to fixed references, in the order of testing: named anchors first.

    The candidate and the champion are left out, as are aliases that do not exist yet.
    Raises UnknownVersion, UnknownPolicy, EnvironmentMismatch and InvalidReference for anchors that cannot play.
    """
    gate = league.config.gate
    former = earlier_champions(registry, league, gate.earlier_champions)
    pinned_anchors: dict[str, AnchorConfig] = {}
    for anchor in [*gate.anchors, *(AnchorConfig(ref=ref) for ref in former)]:
        try:
            ref = pinned(of_league(anchor.ref, league.slug), league.slug, registry)
        except UnknownAlias:
            continue
        check_eligible(ref, registry, league.config)
        if ref not in (candidate, champion):
            pinned_anchors.setdefault(ref, anchor.model_copy(update={"ref": ref}))
    return list(pinned_anchors.values())
