"""What a verdict says about its outcome."""

from datetime import UTC, datetime

import pytest

from evaluation.gating.explanation import Explanation, explain
from evaluation.gating.gate import Decision, Outcome, decide, decision_bounds
from evaluation.gating.gate_result import (
    AnchorResult,
    CompanionResult,
    ExploitabilityResult,
    PairedResult,
    combine_results,
)
from evaluation.results import Difference
from league.config.gate import GateConfig
from league.registry.storage.rows import VerdictRow
from league.verdict_tests import AnchorTest, ExploitabilityTest, ExploiterTest

GATE = GateConfig(model="logistic", elo1=40, alpha=0.05, nights=None, max_blocks=4000)
VERDICT = VerdictRow(
    id="l-verdict-1",
    league="l",
    candidate=3,
    champion="l@2",
    settings={},
    outcome=None,
    evidence=None,
    opened_at=datetime.now(UTC),
    closed_at=None,
)
BOT = "script:bots.solver:act"
EVEN = (10, 20, 40, 20, 10)
WON = decide(GATE, [0.75] * 400)


def decision(outcome: Outcome | None, llr: float = 3.0, counts: tuple[int, ...] = EVEN) -> Decision:
    blocks = sum(counts)
    return Decision(outcome, llr, decision_bounds(GATE), blocks, 2 * blocks, None, counts, (), None)


def explained(
    champion: Decision,
    *tests: CompanionResult,
    gate: GateConfig = GATE,
    forfeits: int = 0,
    note: str | None = None,
    outcome: str | None = None,
    champion_scores: dict[str, float] | None = None,
) -> Explanation:
    seen = combine_results(champion, tests, len(tests), forfeits)
    outcome = outcome or seen.outcome
    return explain(
        VERDICT,
        gate,
        seen,
        outcome=outcome,
        promoted=outcome == "promote" and note is None,
        note=note,
        champion_scores=champion_scores or {},
    )


def paired(outcome: Outcome, own: float, champion: float, llr: float = -3.0) -> PairedResult:
    test = AnchorTest(BOT, 0.1, "s", "no_worse")
    gap = Difference(own - champion, None, None)
    return PairedResult(test, "l@2", decision(outcome, llr), (own, champion), gap)


def test_a_promotion_names_the_scores_in_all_tests() -> None:
    found = explained(WON, paired("promote", 0.267, 0.017))
    assert found.reason.startswith("Stronger: after ")
    assert "It scored 75.0 % against l@2, which scored 25.0 %." in found.reason
    assert f"Against {BOT} it scored 26.7 %, and l@2 1.7 %." in found.reason
    assert found.remedy is None


def test_a_candidate_that_is_not_stronger_is_told_the_score_that_it_needs() -> None:
    found = explained(decision("reject", -3.0))
    assert found.reason.startswith("Not stronger: after 200 games, the LLR was −3.00, below the bound of −2.94.")
    assert found.remedy == "To pass, it must score more than about 52.9 % against l@2 (gate.elo0: 0, gate.elo1: 40)."


def test_the_score_that_is_needed_depends_on_the_deviation_with_normalized_elo() -> None:
    gate = GATE.model_copy(update={"model": "normalized"})
    remedies = [
        explained(decision("reject", -3.0, counts), gate=gate).remedy or ""
        for counts in ((25, 0, 50, 0, 25), (3, 17, 60, 17, 3))
    ]
    assert "52.9 %" in remedies[0]
    assert "51.5 %" in remedies[1]


def test_the_test_against_an_anchor_that_decided_is_named_with_both_scores() -> None:
    anchor = AnchorResult(AnchorTest(BOT, 50.0, "s"), decision("reject", -3.0))
    found = explained(WON, anchor, champion_scores={BOT: 0.017})
    assert found.reason.startswith(f"Rejected: it beat the champion, but is weaker than {BOT}.")
    assert found.reason.endswith(f"Against {BOT} it scored 50.0 % in 200 games; l@2 1.7 % in other games.")
    assert found.remedy == (
        f"To pass, it must score more than about 46.4 % against {BOT} (margin of the anchor: 50)."
        " With mode: no_worse, it need only do as well as the champion there."
    )
    former = AnchorResult(AnchorTest("l@1", 50.0, "s"), decision("reject", -3.0))
    found = explained(WON, former)
    assert found.reason.endswith("l@2 has not played it.")
    assert "no_worse" not in str(found.remedy), "an earlier champion has no mode"


def test_a_paired_test_asks_for_a_score_near_that_of_the_champion() -> None:
    found = explained(WON, paired("reject", 0.4, 0.673))
    assert "does worse than the champion against" in found.reason
    assert found.remedy == f"To pass, it must score more than about 62.3 % against {BOT} (margin of the anchor: 0.1)."
    exploiter = PairedResult(ExploiterTest("l@7", "l@2", 0.1, "s"), "l@2", decision("reject"), (0.4, 0.6), None)
    assert "(gate.exploiter_margin: 0.1)" in str(explained(WON, exploiter).remedy)


@pytest.mark.parametrize(
    ("improvement", "expected"),
    [
        (0.0, "exploiters may achieve at most about 0.05 of all points more against it than against l@2"),
        (0.2, "exploiters must achieve at least about 0.1 of all points less against it than against l@2"),
    ],
)
def test_a_test_of_exploitability_names_what_exploiters_may_achieve(improvement: float, expected: str) -> None:
    test = ExploitabilityTest(("l@4",), ("l@5",), 0.1, 10, "s", improvement)
    result = ExploitabilityResult(test, "l@2", decision("reject"), (), None, None)
    assert expected in str(explained(WON, result).remedy)


@pytest.mark.parametrize(
    ("llr", "expected"),
    [
        (1.5, "At this rate, it passes after about 400 games (gate.max_blocks: 200, now 4000); fewer with gate.elo0"),
        (-1.5, "More games would rather reject it, after about 400 games (gate.max_blocks: 200)."),
        (0.0, "about halfway between the hypotheses, so that more games hardly help: set gate.elo0 and gate.elo1"),
        (1e-5, "about halfway between the hypotheses"),
    ],
)
def test_an_inconclusive_test_says_what_helps(llr: float, expected: str) -> None:
    remedy = explained(decision("inconclusive", llr)).remedy
    assert expected in str(remedy)


def test_an_inconclusive_comparison_names_its_margin() -> None:
    found = explained(WON, paired("inconclusive", 0.5, 0.55, llr=1.0))
    assert "200 games do not show" in found.reason
    assert "fewer with a larger margin of the anchor: 0.1." in str(found.remedy)


def test_other_outcomes() -> None:
    assert "gate.forfeits: true" in str(explained(WON, forfeits=2).remedy)
    assert "it forfeited 2 games" in explained(WON, forfeits=2).reason
    void = explained(WON, outcome="void", note="the champion is l@5 now")
    assert void.reason.startswith("Void: the champion is l@5 now.")
    assert void.remedy == "The next nightly run tests it again, on other games."
    refused = explained(WON, outcome="promote", note="the alias has moved")
    assert "but not promoted: the alias has moved." in refused.reason
    open_test = explained(decision(None, 1.0))
    assert open_test.reason.startswith("Undecided: after 200 games")
    assert open_test.remedy is None
    pending = AnchorResult(AnchorTest("l@1", 50.0, "s"), decision(None, 1.0))
    assert explained(WON, pending).reason.startswith(
        "Undecided: it beat the champion, and further tests are under way."
    )


def test_with_returns_the_bar_is_a_difference_of_returns() -> None:
    gate = GateConfig(model="returns", return_bound=4, return1=1, margin=0.5, nights=None)
    assert "exceed those of l@2 by more than about 0.5" in str(explained(decision("reject"), gate=gate).remedy)
    anchor = AnchorResult(AnchorTest("l@1", 0.5, "s"), decision("reject"))
    assert "at most about 0.25 below those of l@1" in str(explained(WON, anchor, gate=gate).remedy)
    assert "at most about 0.05 in returns worse" in str(explained(WON, paired("reject", 0.4, 0.6), gate=gate).remedy)
