"""Tests of a verdict in words, for the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evaluation.results import AnchorReport, CompanionReport, ExploitabilityReport, ExploiterReport


def against_anchor(test: AnchorReport, champion: str, model: str) -> str:
    """`not inferior to connect_four@1 by 50 Elo after 600 games`, or as against an exploiter. model: of the gate."""
    if test.mode == "no_worse":
        return against_exploiter(test, champion, model)
    unit = "in returns" if model == "returns" else "Elo"
    return _compared(test, "to", test.ref, f"by {test.margin:g} {unit}")


def against_exploiter(test: ExploiterReport | AnchorReport, champion: str, model: str) -> str:
    """`against connect_four@7 not worse than connect_four@1 by 0.1 of all points after 600 games`."""
    return f"against {test.ref} " + _compared(test, "than", champion, f"by {test.margin:g} {margin_unit(model)}")


def exploitability(test: ExploitabilityReport, model: str) -> str:
    """`not more exploitable than connect_four@1 by 0.1 of all points after 600 games`. model: of the gate."""
    by = f"by {test.improvement or test.margin:g} {margin_unit(model)}"
    # That it is less exploitable is shown, but not that it is by the improvement.
    return _compared(test, "than", test.ref, "" if test.outcome == "less exploitable" else by)


def margin_unit(model: str) -> str:
    """The unit of the margins of tests with exploiters."""
    return "in returns" if model == "returns" else "of all points"


def _compared(test: CompanionReport, preposition: str, other: str, by: str) -> str:
    """An undecided test shows nothing about the margin."""
    is_decided = test.outcome not in ("inconclusive", "open")
    comparison = f"{preposition} {other} {by}".rstrip() if is_decided else f"compared with {other}"
    return f"{test.outcome} {comparison} after {test.games} games"
