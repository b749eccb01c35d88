"""Tests of a verdict in words."""

import pytest

from evaluation.reporting import wording
from evaluation.results import AnchorReport, ExploiterReport
from tests.support.reports import exploitability_report

EVIDENCE = (0.0, (-3.0, 3.0), 100, 200, 200, (0, 0, 100, 0, 0))


@pytest.mark.parametrize(
    ("outcome", "model", "expected"),
    [
        ("not inferior", "normalized", "not inferior to memory@1 by 50 Elo after 200 games"),
        ("inferior", "returns", "inferior to memory@1 by 50 in returns after 200 games"),
        ("inconclusive", "normalized", "inconclusive compared with memory@1 after 200 games"),
    ],
)
def test_a_comparison_with_an_anchor(outcome: str, model: str, expected: str) -> None:
    test = AnchorReport("memory@1", 50, "s", outcome, *EVIDENCE, 0.5, 0.0, (-10.0, 10.0))
    assert wording.against_anchor(test, "memory@3", model) == expected


def test_a_comparison_against_an_exploiter_names_the_champion() -> None:
    test = ExploiterReport("memory@7", 0.1, "s", "not worse", *EVIDENCE, "memory@1", 0.5, 0.5, None)
    shown = wording.against_exploiter(test, "memory@1", "logistic")
    assert shown == "against memory@7 not worse than memory@1 by 0.1 of all points after 200 games"


def test_an_anchor_that_is_no_standard_by_itself_is_described_as_an_exploiter() -> None:
    test = AnchorReport("script:one_ply", 0.1, "s", "worse", *EVIDENCE, 0.5, None, None, "no_worse", 0.7)
    shown = wording.against_anchor(test, "memory@1", "normalized")
    assert shown == "against script:one_ply worse than memory@1 by 0.1 of all points after 200 games"


@pytest.mark.parametrize(
    ("outcome", "improvement", "model", "expected"),
    [
        ("not more exploitable", 0.0, "normalized", "not more exploitable than tictactoe@2 by 0.1 of all points"),
        ("more exploitable", 0.0, "returns", "more exploitable than tictactoe@2 by 0.1 in returns"),
        ("less exploitable", 0.05, "normalized", "less exploitable than tictactoe@2"),
        ("not less exploitable", 0.05, "returns", "not less exploitable than tictactoe@2 by 0.05 in returns"),
        ("inconclusive", 0.05, "normalized", "inconclusive compared with tictactoe@2"),
        ("open", 0.0, "normalized", "open compared with tictactoe@2"),
    ],
)
def test_a_comparison_of_exploitability(outcome: str, improvement: float, model: str, expected: str) -> None:
    """An undecided test names no margin, and neither does one that shows a difference of any size."""
    test = exploitability_report(outcome, improvement=improvement)
    assert wording.exploitability(test, model) == f"{expected} after 600 games"
