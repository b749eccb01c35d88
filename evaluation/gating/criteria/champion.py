"""The test against the champion: the candidate is stronger, or not inferior if the gate asks for no gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

from evaluation.gating.criteria.criterion import Contest, Criterion, percent
from evaluation.gating.gate import SequentialTest, decide_matches
from evaluation.gating.gate_result import CriterionResult
from evaluation.statistics.sequential import score_at
from league.config.gate import GateConfig
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow
from league.results.records import Match, Schedule


@dataclass(frozen=True, slots=True, kw_only=True)
class ChampionTest(Criterion):
    """Whether the candidate is stronger than the champion, by the statistics that are fields of the verdict."""

    kind: ClassVar[str] = "verdict"

    @classmethod
    def planned(
        cls,
        registry: Registry,  # noqa: ARG003
        league: LeagueRow,  # noqa: ARG003
        verdict: Schedule,
        gate: GateConfig,  # noqa: ARG003
    ) -> list[tuple[Self, Schedule | None]]:
        return [(cls(schedule=verdict.id), verdict)]

    def sequential(self, contest: Contest) -> SequentialTest:
        return SequentialTest(contest.gate, contest.candidate)

    def result(self, contest: Contest, matches: Sequence[Match]) -> CriterionResult:
        gate, champion, title = contest.gate, contest.champion, contest.title
        decision = decide_matches(self.sequential(contest), matches)
        score, least = decision.score, None
        if gate.model == "returns":
            hypotheses, bar = "gate.return0 and gate.return1", (gate.return0 + gate.return1) / 2
            requirement = f"To pass, its returns must exceed those of {champion} by more than about {bar:g} on average."
        else:
            hypotheses = "gate.elo0 and gate.elo1"
            least = score_at((gate.elo0 + gate.elo1) / 2, decision.counts, gate.model)
            requirement = (
                f"To pass, it must score more than about {percent(least, score)} against {champion}"
                f" (gate.elo0: {gate.elo0:g}, gate.elo1: {gate.elo1:g})."
            )
        scores = None
        if score is not None:
            scores = f"It scored {percent(score, least)} against {champion}, which scored {percent(1 - score, score)}."
        passed, failed = f"is not inferior to {title}", f"is inferior to {title}"
        if gate.requires_gain:
            passed, failed = f"beat {title}", f"is not stronger than {title}"
        return CriterionResult(
            decision=decision,
            report=None,
            passed=passed,
            failed=failed,
            scores=scores,
            requirement=requirement,
            wider=f"{hypotheses} that are further apart",
        )
