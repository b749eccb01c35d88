from typing import get_args

from hypothesis import given
from hypothesis import strategies as st

from evaluation.findings import Anchored, found
from evaluation.gate import Decision, Outcome

OUTCOMES = (None, *get_args(Outcome))


def decision(outcome: Outcome | None) -> Decision:
    return Decision(outcome, 0.0, (-3.0, 3.0), 10, 20, 20, (2, 2, 2, 2, 2), (), None)


def anchored(*outcomes: Outcome | None) -> list[Anchored]:
    return [Anchored(f"l@{i}", 50.0, f"s{i}", decision(outcome)) for i, outcome in enumerate(outcomes)]


outcomes = st.sampled_from(OUTCOMES)


@given(outcomes, st.lists(outcomes, max_size=4), st.integers(0, 3))
def test_only_who_passes_every_test_is_promoted(
    champion: Outcome | None, anchors: list[Outcome | None], forfeits: int
) -> None:
    seen = found(decision(champion), anchored(*anchors), len(anchors), forfeits)
    passed = champion == "promote" and not forfeits and all(outcome == "promote" for outcome in anchors)
    assert (seen.outcome == "promote") == passed
    if champion == "promote" and seen.outcome not in (None, "promote"):
        assert seen.note


@given(outcomes.filter(lambda outcome: outcome != "promote"), st.lists(outcomes, max_size=4))
def test_who_does_not_beat_the_champion_meets_no_anchor(
    champion: Outcome | None, anchors: list[Outcome | None]
) -> None:
    seen = found(decision(champion), anchored(*anchors), len(anchors), None)
    assert (seen.outcome, seen.anchors, seen.note) == (champion, (), None)


def test_the_first_anchor_that_is_not_passed_ends_it() -> None:
    seen = found(decision("promote"), anchored("promote", "reject", "promote"), 3, None)
    assert [anchor.ref for anchor in seen.anchors] == ["l@0", "l@1"]
    assert (seen.outcome, seen.note) == ("reject", "it beat the champion, but is weaker than l@1")


def test_an_anchor_that_games_cannot_settle_leaves_the_champion() -> None:
    seen = found(decision("promote"), anchored("inconclusive"), 1, None)
    assert seen.outcome == "inconclusive"
    assert "20 games do not show that it is at most 50 weaker than l@0" in str(seen.note)


def test_an_anchor_whose_test_has_not_begun_keeps_it_open() -> None:
    assert found(decision("promote"), anchored("promote"), 2, None).outcome is None
