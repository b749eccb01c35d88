from typing import get_args

from hypothesis import given
from hypothesis import strategies as st

from evaluation.gating.gate import Decision, Outcome
from evaluation.gating.gate_result import AnchorResult, combine_results
from league.verdict_tests import AnchorTest

OUTCOMES = (None, *get_args(Outcome))


def decision(outcome: Outcome | None) -> Decision:
    return Decision(outcome, 0.0, (-3.0, 3.0), 10, 20, 20, (2, 2, 2, 2, 2), (), None)


def anchor_results(*outcomes: Outcome | None) -> list[AnchorResult]:
    return [AnchorResult(AnchorTest(f"l@{i}", 50.0, f"s{i}"), decision(outcome)) for i, outcome in enumerate(outcomes)]


outcomes = st.sampled_from(OUTCOMES)


@given(outcomes, st.lists(outcomes, max_size=4), st.integers(0, 3))
def test_only_a_candidate_that_passes_all_tests_is_promoted(
    champion: Outcome | None, anchors: list[Outcome | None], forfeits: int
) -> None:
    result = combine_results(decision(champion), anchor_results(*anchors), len(anchors), forfeits)
    passed = champion == "promote" and not forfeits and all(outcome == "promote" for outcome in anchors)
    assert (result.outcome == "promote") == passed
    if champion == "promote" and result.outcome not in (None, "promote"):
        assert result.note


@given(outcomes.filter(lambda outcome: outcome != "promote"), st.lists(outcomes, max_size=4))
def test_anchors_are_not_tested_unless_the_champion_is_beaten(
    champion: Outcome | None, anchors: list[Outcome | None]
) -> None:
    result = combine_results(decision(champion), anchor_results(*anchors), len(anchors), None)
    assert (result.outcome, result.anchors, result.note) == (champion, (), None)


def test_the_first_failed_anchor_ends_the_test() -> None:
    result = combine_results(decision("promote"), anchor_results("promote", "reject", "promote"), 3, None)
    assert [anchor.test.ref for anchor in result.anchors] == ["l@0", "l@1"]
    assert (result.outcome, result.note) == ("reject", "it beat the champion, but is weaker than l@1")


def test_an_inconclusive_anchor_keeps_the_champion() -> None:
    result = combine_results(decision("promote"), anchor_results("inconclusive"), 1, None)
    assert result.outcome == "inconclusive"
    assert "20 games do not show that it is at most 50 weaker than l@0" in str(result.note)


def test_a_missing_anchor_result_keeps_it_open() -> None:
    assert combine_results(decision("promote"), anchor_results("promote"), 2, None).outcome is None
