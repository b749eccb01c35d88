"""The result of a gate: the tests of a candidate in order, and what they decide together.

A candidate that must pass all tests is promoted wrongly with at most the α of one (R. L. Berger, "Multiparameter
hypothesis testing and acceptance sampling", Technometrics 24, 1982).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from evaluation.gating.gate import Decision, Outcome, decide_pairs
from evaluation.gating.observations import matches_each, observe
from evaluation.results import Difference
from evaluation.statistics.payoff import crossed_interval, student_interval
from league.config.gate import GateConfig
from league.results.records import Match


@dataclass(frozen=True, slots=True)
class AnchorResult:
    """A non-inferiority test against one anchor. margin: by how much the candidate may be weaker."""

    ref: str
    margin: float
    schedule: str
    decision: Decision

    @property
    def failure(self) -> str:
        """What a `reject` shows."""
        return f"is weaker than {self.ref}"

    @property
    def claim(self) -> str:
        """What a `promote` shows."""
        return f"is at most {self.margin:g} weaker than {self.ref}"


@dataclass(frozen=True, slots=True)
class ExploiterResult:
    """A paired test of candidate and champion against one exploiter.

    Attributes:
        ref: The exploiter.
        exploits: The champion that it was trained against.
        margin: By how much the candidate may be worse than the champion.
        schedule: Id of the schedule.
        decision: The test, whose blocks are pairs of blocks.
        scores: Mean scores of candidate and champion over the counted pairs; None without pairs.
        difference: Score of the candidate minus the champion's, or its difference of returns if the gate tests returns.
    """

    ref: str
    exploits: str
    margin: float
    schedule: str
    decision: Decision
    scores: tuple[float, float] | None
    difference: Difference | None

    @property
    def failure(self) -> str:
        """What a `reject` shows."""
        return f"does worse than the champion against {self.ref}, an exploiter of {self.exploits}"

    @property
    def claim(self) -> str:
        """What a `promote` shows."""
        return f"is at most {self.margin:g} worse than the champion against {self.ref}, an exploiter of {self.exploits}"


def exploiter_result(
    settings: GateConfig, matches: Sequence[Match], candidate: str, champion: str, exploiter: Mapping[str, Any]
) -> ExploiterResult:
    """Test candidate and champion against an exploiter. exploiter: its record in the settings of the verdict."""
    ref, exploits, margin, schedule = (exploiter[name] for name in ("ref", "exploits", "margin", "schedule"))
    test = settings.against_exploiter(margin)
    decision = decide_pairs(test, matches, candidate, champion)
    counted = matches[: 2 * decision.blocks]
    gaps, scores = observe(test, counted, candidate, champion).gaps, None
    if counted:
        own, other = (
            sum(match.score(match.contestants.index(each)) for match in counted if each in match.contestants)
            for each in (candidate, champion)
        )
        scores = own / decision.blocks, other / decision.blocks
    gap = student_interval(gaps) if gaps else None
    return ExploiterResult(ref, exploits, margin, schedule, decision, scores, gap)


@dataclass(frozen=True, slots=True)
class ExploitabilityResult:
    """A test of candidate and champion, each against exploiters trained against it.

    Attributes:
        ref: The champion.
        margin: By how much the candidate may be more exploitable.
        improvement: By how much it must be less exploitable; 0 if it need not be.
        schedule: Id of the schedule.
        decision: The test, whose blocks are rounds: one block of each exploiter.
        of_candidate: Exploiters of the candidate.
        of_champion: As many exploiters of the champion.
        sample: Matches of the fixed number of rounds from which exploitability is estimated; empty before these.
        difference: Score of the candidate's exploiters minus that of the champion's, or the difference of their gains
            if the gate tests returns; with an interval over blocks. None without a sample.
        difference_over_exploiters: The same, with an interval over blocks and exploiters.
    """

    ref: str
    margin: float
    improvement: float
    schedule: str
    decision: Decision
    of_candidate: tuple[str, ...]
    of_champion: tuple[str, ...]
    sample: Sequence[Match]
    difference: Difference | None
    difference_over_exploiters: Difference | None

    @property
    def failure(self) -> str:
        """What a `reject` shows."""
        more = "not less" if self.improvement else "more"
        return f"is {more} exploitable than {self.ref} by exploiters trained against each"

    @property
    def claim(self) -> str:
        """What a `promote` shows."""
        less = "less" if self.improvement else f"at most {self.margin:g} more"
        return f"is {less} exploitable than {self.ref} by exploiters trained against each"


def exploitability_settings(settings: GateConfig, test: Mapping[str, Any]) -> GateConfig:
    """Return the settings of a test of exploitability. test: its record in the settings of the verdict."""
    return settings.of_exploitability(test["margin"], test.get("improvement", 0.0))


def exploitability_result(
    settings: GateConfig, matches: Sequence[Match], candidate: str, champion: str, test: Mapping[str, Any]
) -> ExploitabilityResult:
    """Compare the exploitability of candidate and champion. test: its record in the settings of the verdict."""
    exploiters, against = tuple(test["of_candidate"]), exploitability_settings(settings, test)
    pairs = len(exploiters)
    decision = decide_pairs(against, matches, candidate, champion, pairs)
    size = test["blocks"] * matches_each(champion, pairs)
    sample = matches[:size] if len(matches) >= size else ()
    by_block = by_exploiter = None
    if sample:
        gaps = -np.array([observe(against, each, candidate, champion).gaps for each in _pairs(sample, pairs)])
        by_block, by_exploiter = student_interval(gaps.mean(axis=0).tolist()), crossed_interval(gaps)
    return ExploitabilityResult(
        ref=champion,
        margin=test["margin"],
        improvement=test.get("improvement", 0.0),
        schedule=test["schedule"],
        decision=decision,
        of_candidate=exploiters,
        of_champion=tuple(test["of_champion"]),
        sample=sample,
        difference=by_block,
        difference_over_exploiters=by_exploiter,
    )


def _pairs(matches: Sequence[Match], pairs: int) -> list[list[Match]]:
    """The matches of whole rounds, by the pair of exploiters that played them."""
    return [[match for i, match in enumerate(matches) if i // 2 % pairs == pair] for pair in range(pairs)]


CompanionResult = AnchorResult | ExploiterResult | ExploitabilityResult


@dataclass(frozen=True, slots=True)
class GateResult:
    """Results of all tests of a candidate.

    companions: started tests after that against the champion, in order, of `planned_companions` in total.
    forfeits: forfeited games, or None if the gate allows them.
    shown: what the first test showed if it is passed.
    """

    champion: Decision
    companions: tuple[CompanionResult, ...] = ()
    planned_companions: int = 0
    forfeits: int | None = None
    shown: str = "it beat the champion"

    @property
    def anchors(self) -> tuple[AnchorResult, ...]:
        return tuple(each for each in self.companions if isinstance(each, AnchorResult))

    @property
    def exploiters(self) -> tuple[ExploiterResult, ...]:
        return tuple(each for each in self.companions if isinstance(each, ExploiterResult))

    @property
    def exploitability(self) -> ExploitabilityResult | None:
        return next((each for each in self.companions if isinstance(each, ExploitabilityResult)), None)

    @property
    def outcome(self) -> Outcome | None:
        """Outcome of the verdict; None while a test is open."""
        return self._conclusion()[0]

    @property
    def note(self) -> str | None:
        """Why the candidate is not promoted although it passed the test against the champion."""
        return self._conclusion()[1]

    def _conclusion(self) -> tuple[Outcome | None, str | None]:
        if self.champion.outcome != "promote":
            return self.champion.outcome, None
        if self.forfeits:
            return "reject", f"it forfeited {self.forfeits} games, but the gate allows none"
        for test in self.companions:
            if test.decision.outcome == "reject":
                return "reject", f"{self.shown}, but {test.failure}"
            if test.decision.outcome == "inconclusive":
                games = test.decision.games
                return "inconclusive", f"{self.shown}, but {games} games do not show that it {test.claim}"
        is_complete = len(self.companions) == self.planned_companions and all(map(_is_passed, self.companions))
        return ("promote" if is_complete else None), None


def _is_passed(test: CompanionResult) -> bool:
    return test.decision.outcome == "promote"


def combine_results(
    champion: Decision,
    companions: Sequence[CompanionResult],
    planned_companions: int,
    forfeits: int | None,
    shown: str = "it beat the champion",
) -> GateResult:
    """Combine the tests up to the first one after the champion's that is not passed. Later ones are ignored."""
    looked_at: list[CompanionResult] = []
    for test in companions if champion.outcome == "promote" and not forfeits else ():
        looked_at.append(test)
        if not _is_passed(test):
            break
    return GateResult(champion, tuple(looked_at), planned_companions, forfeits, shown)
