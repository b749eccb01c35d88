from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.gating.gate import Decision, Outcome, decision_bounds
from evaluation.gating.gate_result import CriterionResult, GateResult
from league.config.gate import GateConfig
from tests.support.gate_results import decided

GATE = GateConfig(model="logistic", elo1=40, alpha=0.05, nights=None, max_blocks=4000)
EVEN = (10, 20, 40, 20, 10)


def decision(outcome: Outcome | None, llr: float = 3.0) -> Decision:
    blocks = sum(EVEN)
    return Decision(outcome, llr, decision_bounds(GATE), blocks, 2 * blocks, None, EVEN, (), None)


def gate_result(
    champion: Outcome | None, *further: Outcome | None, planned: int | None = None, forfeits: int = 0, llr: float = 3.0
) -> GateResult:
    """Results of tests with these outcomes, as far as they are looked at."""
    results: list[CriterionResult] = []
    for outcome in further if champion == "promote" and not forfeits else ():
        results.append(decided(decision(outcome, llr), "is at most 50 weaker than l@1", "is weaker than l@1"))
        if outcome != "promote":
            break
    number = len(further) if planned is None else planned
    first = decided(decision(champion, llr), scores="It scored 50.0 % against l@2.")
    return GateResult(GATE, first, tuple(results), number, forfeits)


outcomes = st.sampled_from((None, *get_args(Outcome)))


@given(outcomes, st.lists(outcomes, max_size=4), st.integers(0, 3))
def test_only_a_candidate_that_passes_all_tests_is_promoted(
    champion: Outcome | None, further: list[Outcome | None], forfeits: int
) -> None:
    result = gate_result(champion, *further, forfeits=forfeits)
    passed = champion == "promote" and not forfeits and all(outcome == "promote" for outcome in further)
    assert (result.outcome == "promote") == passed
    if champion == "promote" and result.outcome not in (None, "promote"):
        assert result.note


@given(outcomes.filter(lambda outcome: outcome != "promote"))
def test_the_test_against_the_champion_decides_unless_it_is_passed(champion: Outcome | None) -> None:
    result = gate_result(champion, planned=2)
    assert (result.outcome, result.note) == (champion, None)


def test_a_failed_test_is_named() -> None:
    result = gate_result("promote", "promote", "reject", "promote")
    assert (result.outcome, result.note) == ("reject", "it beat the champion, but is weaker than l@1")


def test_an_inconclusive_test_keeps_the_champion() -> None:
    result = gate_result("promote", "inconclusive")
    assert result.outcome == "inconclusive"
    assert result.note == "it beat the champion, but 200 games do not show that it is at most 50 weaker than l@1"


def test_a_test_that_was_not_started_keeps_it_open() -> None:
    assert gate_result("promote", "promote", planned=2).outcome is None


def test_a_promotion_and_a_rejection_name_the_bound() -> None:
    promoted = gate_result("promote").reason("promote", True, None)
    assert promoted == (
        "Stronger: after 200 games, the LLR was 3.00, above the bound of 2.94. It scored 50.0 % against l@2."
    )
    rejected = gate_result("reject", llr=-3.0)
    assert rejected.reason("reject", False, None).startswith("Not stronger: after 200 games, the LLR was −3.00, below")
    assert rejected.remedy("reject", False) == "To pass, it must do better."


def test_other_outcomes() -> None:
    forfeited, passed = gate_result("promote", forfeits=2), gate_result("promote")
    assert "gate.forfeits: true" in str(forfeited.remedy("reject", False))
    assert "it forfeited 2 games" in forfeited.reason("reject", False, None)
    assert passed.reason("void", False, "the champion is l@5 now").startswith("Void: the champion is l@5 now.")
    assert passed.remedy("void", False) == "The next nightly run tests it again, on other games."
    assert "but not promoted: the alias has moved." in passed.reason("promote", False, "the alias has moved")
    assert gate_result(None).reason(None, False, None).startswith("Undecided: after 200 games")
    assert gate_result(None).remedy(None, False) is None
    pending = gate_result("promote", None).reason(None, False, None)
    assert pending.startswith("Undecided: it beat the champion, and further tests are under way.")


@pytest.mark.parametrize(
    ("llr", "expected"),
    [
        (1.5, "At this rate, it passes after about 400 games (gate.max_blocks: 200, now 4000); fewer with a larger"),
        (-1.5, "More games would rather reject it, after about 400 games (gate.max_blocks: 200)."),
        (0.0, "about halfway between the hypotheses, so that more games hardly help: set a larger margin"),
        (1e-5, "about halfway between the hypotheses"),
    ],
)
def test_an_inconclusive_test_says_what_helps(llr: float, expected: str) -> None:
    for result in (gate_result("inconclusive", llr=llr), gate_result("promote", "inconclusive", llr=llr)):
        assert expected in str(result.remedy("inconclusive", False))
