"""The sequential tests of a verdict: hypotheses, contestants, and how many matches are one observation."""

from __future__ import annotations

from dataclasses import dataclass

from league.config.gate import GateConfig
from league.verdict_tests import AnchorTest, CompanionTest, ExploitabilityTest, ExploiterTest


@dataclass(frozen=True, slots=True)
class SequentialTest:
    """A sequential test of a candidate.

    Attributes:
        settings: The gate's settings, with the hypotheses of this test.
        candidate: Reference of the candidate.
        champion: For a comparison with the champion against others, the contestant of every second match. None for a
            test against one opponent.
        pairs: Pairs of matches in a round.
        at_least: Observations to be made even if fewer decide the test.
    """

    settings: GateConfig
    candidate: str
    champion: str | None = None
    pairs: int = 1
    at_least: int = 0

    @property
    def matches_each(self) -> int:
        """Matches per observation."""
        return 1 if self.champion is None else 2 * self.pairs


def sequential_test(gate: GateConfig, test: CompanionTest, candidate: str, champion: str) -> SequentialTest:
    """Return how a test of a verdict is decided. gate: the settings of the test against the champion."""
    match test:
        case AnchorTest(mode="at_least"):
            return SequentialTest(gate.against_anchor(test.margin), candidate)
        case AnchorTest() | ExploiterTest():
            return SequentialTest(gate.compared_with_champion(test.margin), candidate, champion)
        case ExploitabilityTest():
            settings = gate.of_exploitability(test.margin, test.improvement)
            return SequentialTest(settings, candidate, champion, pairs=len(test.of_candidate), at_least=test.blocks)
