"""The result of a gate: the tests of a candidate in order, and what they decide together.

A candidate that must pass all tests is promoted wrongly with at most the α of one (R. L. Berger, "Multiparameter
hypothesis testing and acceptance sampling", Technometrics 24, 1982).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from evaluation.gating.gate import Decision, Outcome, decide_matches
from evaluation.gating.observations import observe
from evaluation.gating.sequential_tests import SequentialTest, sequential_test
from evaluation.results import Difference
from evaluation.statistics.payoff import crossed_interval, student_interval
from league.config.gate import GateConfig
from league.refs import CheckpointRef, parse_ref
from league.results.records import Match
from league.verdict_tests import AnchorTest, CompanionTest, ExploitabilityTest, ExploiterTest


@dataclass(frozen=True, slots=True)
class AnchorResult:
    """Result of a non-inferiority test against one anchor, with the mode `at_least`."""

    test: AnchorTest
    decision: Decision

    @property
    def failure(self) -> str:
        """What a `reject` shows."""
        return f"is weaker than {self.test.ref}"

    @property
    def claim(self) -> str:
        """What a `promote` shows."""
        return f"is at most {self.test.margin:g} weaker than {self.test.ref}"


@dataclass(frozen=True, slots=True)
class PairedResult:
    """Result of a paired test of candidate and champion against one exploiter, or an anchor with the mode `no_worse`.

    Attributes:
        test: The test.
        champion: Reference of the champion.
        decision: Its decision, whose blocks are pairs of blocks.
        scores: Mean scores of candidate and champion over the counted pairs; None without pairs.
        difference: Score of the candidate minus the champion's, or its difference of returns if the gate tests returns.
    """

    test: ExploiterTest | AnchorTest
    champion: str
    decision: Decision
    scores: tuple[float, float] | None
    difference: Difference | None

    @property
    def failure(self) -> str:
        """What a `reject` shows."""
        return f"does worse than {name_of_champion(self.champion)} against {self._opponent}"

    @property
    def claim(self) -> str:
        """What a `promote` shows."""
        worse = f"at most {self.test.margin:g} worse than {name_of_champion(self.champion)}"
        return f"is {worse} against {self._opponent}"

    @property
    def _opponent(self) -> str:
        match self.test:
            case AnchorTest(ref=ref):
                return ref
            case ExploiterTest(ref=ref, exploits=target):
                return f"{ref}, an exploiter of {target}"


@dataclass(frozen=True, slots=True)
class ExploitabilityResult:
    """Result of a test of candidate and champion, each against exploiters trained against it.

    Attributes:
        test: The test.
        champion: Reference of the champion.
        decision: Its decision, whose blocks are rounds: one block of each exploiter.
        sample: Matches of the fixed number of rounds from which exploitability is estimated; empty before these.
        difference: Score of the candidate's exploiters minus that of the champion's, or the difference of their gains
            if the gate tests returns; with an interval over blocks. None without a sample.
        difference_over_exploiters: The same, with an interval over blocks and exploiters.
    """

    test: ExploitabilityTest
    champion: str
    decision: Decision
    sample: Sequence[Match]
    difference: Difference | None
    difference_over_exploiters: Difference | None

    @property
    def failure(self) -> str:
        """What a `reject` shows."""
        more = "not less" if self.test.improvement else "more"
        return f"is {more} exploitable than {self.champion} by exploiters trained against each"

    @property
    def claim(self) -> str:
        """What a `promote` shows."""
        less = "less" if self.test.improvement else f"at most {self.test.margin:g} more"
        return f"is {less} exploitable than {self.champion} by exploiters trained against each"


CompanionResult = AnchorResult | PairedResult | ExploitabilityResult


def name_of_champion(opponent: str) -> str:
    """`the champion`, or the script that is the opponent of a verdict without a champion."""
    return "the champion" if isinstance(parse_ref(opponent), CheckpointRef) else opponent


def companion_result(
    gate: GateConfig, test: CompanionTest, candidate: str, champion: str, matches: Sequence[Match]
) -> CompanionResult:
    """Decide a test of a verdict. gate: as in `sequential_test`. matches: those of the test, in schedule order."""
    sequential = sequential_test(gate, test, candidate, champion)
    decision = decide_matches(sequential, matches)
    match test:
        case AnchorTest(mode="at_least"):
            return AnchorResult(test, decision)
        case AnchorTest() | ExploiterTest():
            counted = matches[: decision.blocks * sequential.matches_each]
            return _paired_result(test, champion, decision, sequential, counted)
        case ExploitabilityTest():
            size = sequential.at_least * sequential.matches_each
            return _exploitability_result(test, decision, sequential, matches[:size] if len(matches) >= size else ())


def _paired_result(
    test: ExploiterTest | AnchorTest,
    champion: str,
    decision: Decision,
    sequential: SequentialTest,
    counted: Sequence[Match],
) -> PairedResult:
    if not counted:
        return PairedResult(test, champion, decision, None, None)
    candidate_total, champion_total = (
        sum(match.score(match.contestants.index(ref)) for match in counted if ref in match.contestants)
        for ref in (sequential.candidate, sequential.champion)
    )
    scores = candidate_total / decision.blocks, champion_total / decision.blocks
    return PairedResult(test, champion, decision, scores, student_interval(observe(sequential, counted).gaps))


def _exploitability_result(
    test: ExploitabilityTest, decision: Decision, sequential: SequentialTest, sample: Sequence[Match]
) -> ExploitabilityResult:
    assert sequential.champion is not None, "it compares candidate and champion"
    by_block = by_exploiter = None
    if sample:
        pair = replace(sequential, pairs=1)
        gaps = -np.array([observe(pair, pair_matches).gaps for pair_matches in _pairs(sample, sequential.pairs)])
        by_block, by_exploiter = student_interval(gaps.mean(axis=0).tolist()), crossed_interval(gaps)
    return ExploitabilityResult(test, sequential.champion, decision, sample, by_block, by_exploiter)


def _pairs(matches: Sequence[Match], pairs: int) -> list[list[Match]]:
    """The matches of whole rounds, by the pair of exploiters that played them."""
    return [[match for i, match in enumerate(matches) if i // 2 % pairs == pair] for pair in range(pairs)]


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
    def anchors(self) -> tuple[AnchorResult | PairedResult, ...]:
        results = (result for result in self.companions if isinstance(result, AnchorResult | PairedResult))
        return tuple(result for result in results if isinstance(result.test, AnchorTest))

    @property
    def exploiters(self) -> tuple[PairedResult, ...]:
        results = (result for result in self.companions if isinstance(result, PairedResult))
        return tuple(result for result in results if isinstance(result.test, ExploiterTest))

    @property
    def exploitability(self) -> ExploitabilityResult | None:
        return next((result for result in self.companions if isinstance(result, ExploitabilityResult)), None)

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
