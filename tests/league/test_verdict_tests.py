import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.verdict_tests import AnchorTest, CompanionTests, ExploitabilityTest, ExploiterTest

refs, margins = st.integers(1, 99).map("league@{}".format), st.floats(0.01, 100)
exploitability = st.builds(
    ExploitabilityTest,
    of_candidate=st.lists(refs, min_size=1).map(tuple),
    of_champion=st.lists(refs, min_size=1).map(tuple),
    margin=margins,
    blocks=st.integers(1, 1000),
    schedule=st.text(min_size=1),
    improvement=margins,
)
companion_tests = st.builds(
    CompanionTests,
    anchors=st.lists(st.builds(AnchorTest, refs, margins, st.text(min_size=1))).map(tuple),
    exploiters=st.lists(st.builds(ExploiterTest, refs, refs, margins, st.text(min_size=1))).map(tuple),
    exploitability=st.none() | exploitability,
    awaits_exploiters=st.booleans(),
    confirmation=st.none() | st.text(min_size=1),
).filter(lambda tests: tests.exploitability is None or not tests.awaits_exploiters)


@given(companion_tests)
def test_recorded_tests_are_read_as_they_were_written(tests: CompanionTests) -> None:
    settings = tests.to_settings()
    assert json.loads(json.dumps(settings)) == settings
    assert CompanionTests.of_settings(settings) == tests


@pytest.mark.parametrize("settings", [{}, {"gate": {}, "night": 1, "anchors": []}])
def test_a_verdict_may_have_no_companion_tests(settings: dict[str, object]) -> None:
    assert CompanionTests.of_settings(settings) == CompanionTests()


def test_settings_of_a_later_release_are_ignored() -> None:
    """Versions are still removed, and snapshots made, by programs that were not updated yet."""
    anchor = {"ref": "l@1", "margin": 50.0, "schedule": "a", "mode": "at_least", "new": 1}
    assert CompanionTests.of_settings({"anchors": [anchor]}).anchors == (AnchorTest("l@1", 50.0, "a"),)


def test_a_test_whose_exploiters_are_not_trained_counts_but_is_not_ready() -> None:
    tests = CompanionTests(anchors=(AnchorTest("l@1", 50.0, "a"),), awaits_exploiters=True)
    assert (tests.ready, tests.number) == (tests.anchors, 2)
