"""The result of a gate: what the tests of a candidate show, what they decide together, and why, in sentences.

A candidate that must pass all tests is promoted wrongly with at most the α of one (R. L. Berger, "Multiparameter
hypothesis testing and acceptance sampling", Technometrics 24, 1982).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from evaluation.documents import Document
from evaluation.gating.gate import Decision, Outcome
from league.config.gate import GateConfig

MOST_GAMES = 1_000_000
"""Games beyond which an estimate of those that a test needs is of no use."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CriterionReport(Document):
    """A test of a verdict after that against the champion, with its evidence as in a VerdictReport.

    ref: the other contestant. margin: by how much the candidate may be worse. schedule: of the matches that count.
    outcome: passed, failed, `inconclusive`, or `open` if the verdict was voided before its end.
    finding: the outcome in words, such as `not inferior to connect_four@1 by 50 Elo after 600 games`.
    """

    ref: str
    margin: float
    schedule: str
    outcome: str
    llr: float
    bounds: tuple[float, float]
    blocks: int
    games: int
    unique_games: int
    counts: tuple[int, ...]
    finding: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CriterionResult:
    """What the matches of one test show, in numbers and in words.

    Attributes:
        decision: Of the test.
        report: Its evidence; None for the test against the champion, whose evidence are fields of the verdict.
        passed: What a `promote` shows, without a subject: `beat the champion`.
        failed: What a `reject` shows: `is weaker than connect_four@1`.
        scores: The scores of candidate and champion as a sentence; None without games.
        requirement: What passes the test, as a sentence.
        wider: Settings that need fewer games: `a larger margin of the anchor: 50`.
    """

    decision: Decision
    report: CriterionReport | None
    passed: str
    failed: str
    scores: str | None
    requirement: str
    wider: str


@dataclass(frozen=True, slots=True)
class GateResult:
    """Results of all tests of a candidate.

    Attributes:
        gate: The settings of the test against the champion.
        champion: The result of that test.
        further: Results of the tests after it that were started, in order, up to the first that is not passed.
        planned: Number of tests after that against the champion.
        forfeits: Games that the candidate forfeited, or None if the gate allows them.
    """

    gate: GateConfig
    champion: CriterionResult
    further: tuple[CriterionResult, ...] = ()
    planned: int = 0
    forfeits: int | None = None

    @property
    def outcome(self) -> Outcome | None:
        """Outcome of the verdict; None while a test is open."""
        if self.champion.decision.outcome != "promote":
            return self.champion.decision.outcome
        if self.forfeits:
            return "reject"
        if not self.further or self.further[-1].decision.outcome == "promote":
            return "promote" if len(self.further) == self.planned else None
        return self.further[-1].decision.outcome

    @property
    def note(self) -> str | None:
        """Why the candidate is not promoted although it passed the test against the champion."""
        if self.outcome in (None, "promote") or self.champion.decision.outcome != "promote":
            return None
        if self.forfeits:
            return f"it forfeited {self.forfeits} games, but the gate allows none"
        last = self.further[-1]
        if self.outcome == "reject":
            return f"it {self.champion.passed}, but {last.failed}"
        return f"it {self.champion.passed}, but {last.decision.games} games do not show that it {last.passed}"

    def reason(self, outcome: str | None, promoted: bool, note: str | None) -> str:
        """What decided, and the scores of candidate and champion in each test that was played.

        Args:
            outcome: Outcome of the verdict; None while it is open.
            promoted: Whether it made the candidate champion.
            note: Why it is void, or was not applied.
        """
        scores = [result.scores for result in (self.champion, *self.further) if result.scores is not None]
        return " ".join((self._finding(outcome, promoted, note), *scores))

    def _finding(self, outcome: str | None, promoted: bool, note: str | None) -> str:
        decision = self.champion.decision
        passed, failed = ("Stronger", "Not stronger") if self.gate.requires_gain else ("Not inferior", "Inferior")
        llr, lower, upper = (f"{value:.2f}".replace("-", "−") for value in (decision.llr, *decision.bounds))
        after = f"after {decision.games} games, the LLR was {llr}"
        if outcome in ("reject", "inconclusive"):
            note = self.note or note
        match outcome:
            case None if decision.outcome == "promote":
                return f"Undecided: it {self.champion.passed}, and further tests are under way."
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

    def remedy(self, outcome: str | None, promoted: bool) -> str | None:
        """What would have to change for a promotion; None after one, and while the verdict is open.

        outcome, promoted: as in `reason`.
        """
        if outcome is None or promoted:
            return None
        if outcome not in ("reject", "inconclusive"):
            return "The next nightly run tests it again, on other games."
        if self.champion.decision.outcome == "promote" and self.forfeits:
            return "It must return a legal action in each game. With gate.forfeits: true, forfeits are only lost games."
        failures = (result for result in self.further if result.decision.outcome in ("reject", "inconclusive"))
        result = next(failures, self.champion)
        if outcome == "reject" or not result.decision.blocks:
            return result.requirement
        return f"{result.requirement} {self._more_games(result)}"

    def _more_games(self, result: CriterionResult) -> str:
        """What decides a test that was not decided by `gate.max_blocks`."""
        decision = result.decision
        lower, upper = decision.bounds
        rate = decision.llr / decision.blocks
        blocks = math.inf if rate == 0 else (upper if rate > 0 else lower) / rate
        games = blocks * decision.games / decision.blocks
        if games > MOST_GAMES:
            return f"It is about halfway between the hypotheses, so that more games hardly help: set {result.wider}."
        number = _rounded(blocks)
        if rate < 0:
            return (
                f"More games would rather reject it, after about {_rounded(games):,} games (gate.max_blocks: {number})."
            )
        return (
            f"At this rate, it passes after about {_rounded(games):,} games (gate.max_blocks: {number}, now"
            f" {self.gate.max_blocks}); fewer with {result.wider}."
        )


def _rounded(number: float) -> int:
    """Two significant digits, rounded up."""
    unit = 10 ** max(int(math.log10(number)) - 1, 0)
    return math.ceil(number / unit) * unit
