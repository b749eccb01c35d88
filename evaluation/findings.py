"""What a gate finds: the test against the champion, then one against each anchor, and what follows from all of them.

A challenger is promoted only if it passes every one. So the chance that one is promoted which is no better than the
champion, or inferior to any anchor, is at most the verdict's alpha (an intersection-union test: R. L. Berger,
"Multiparameter hypothesis testing and acceptance sampling", Technometrics 24, 1982).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from evaluation.gate import Decision, Outcome


@dataclass(frozen=True, slots=True)
class Anchored:
    """The test of non-inferiority to one anchor. margin: by how much the challenger may be weaker."""

    ref: str
    margin: float
    schedule: str
    decision: Decision

    @property
    def is_passed(self) -> bool:
        return self.decision.outcome == "promote"


@dataclass(frozen=True, slots=True)
class Findings:
    """All that was found of a challenger. anchors: those that have been begun, in their order, of `asked` in all.

    forfeits: games that it forfeited, or None where those do not matter.
    """

    champion: Decision
    anchors: tuple[Anchored, ...] = ()
    asked: int = 0
    forfeits: int | None = None

    @property
    def outcome(self) -> Outcome | None:
        """What the verdict is; None while a test is open."""
        return self._conclusion()[0]

    @property
    def note(self) -> str | None:
        """Why the challenger is not promoted though it beat the champion."""
        return self._conclusion()[1]

    def _conclusion(self) -> tuple[Outcome | None, str | None]:
        if self.champion.outcome != "promote":
            return self.champion.outcome, None
        if self.forfeits:
            return "reject", f"it forfeited {self.forfeits} games, and its gate allows none"
        for anchor in self.anchors:
            if anchor.decision.outcome == "reject":
                return "reject", f"it beat the champion, but is weaker than {anchor.ref}"
            if anchor.decision.outcome == "inconclusive":
                return "inconclusive", (
                    f"it beat the champion, but {anchor.decision.games} games do not show that it is at most"
                    f" {anchor.margin:g} weaker than {anchor.ref}"
                )
        is_complete = len(self.anchors) == self.asked and all(anchor.is_passed for anchor in self.anchors)
        return ("promote" if is_complete else None), None


def found(champion: Decision, anchors: Sequence[Anchored], asked: int, forfeits: int | None) -> Findings:
    """Put together what was found, up to the first anchor that was not passed: those behind it are not looked at."""
    looked_at: list[Anchored] = []
    for anchor in anchors if champion.outcome == "promote" and not forfeits else ():
        looked_at.append(anchor)
        if not anchor.is_passed:
            break
    return Findings(champion, tuple(looked_at), asked, forfeits)
