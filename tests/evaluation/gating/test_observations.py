from dataclasses import replace

import pytest

from evaluation.gating.gate import decide_matches
from evaluation.gating.observations import observe
from evaluation.gating.sequential_tests import SequentialTest
from league.config.gate import GateConfig
from league.results.records import Game, Match

GATE = GateConfig()


def match(contestants: tuple[str, str], score: float) -> Match:
    """A block in which the first contestant has this score in both games."""
    games = tuple(Game((i, 1 - i), 1, (), (), (score, -score), (score, 1 - score)) for i in (0, 1))
    return Match("s/0", "league", "s", 0, contestants, 1, "digest", games)


def round_of(own: tuple[float, ...], other: tuple[float, ...]) -> list[Match]:
    """A round in which candidate and champion have these scores against their exploiters."""
    pairs = zip(own, other, strict=True)
    return [match((who, f"{who}-{i}"), s) for i, both in enumerate(pairs) for who, s in zip("ab", both, strict=True)]


def test_a_round_is_one_observation_of_mean_scores() -> None:
    matches = [*round_of((1.0, 0.5), (0.0, 0.5)), *round_of((0.0, 0.0), (1.0, 0.5))]
    test = SequentialTest(GATE, "a", "b", pairs=2)
    seen = observe(test, matches)
    assert seen.scores == pytest.approx([0.5 + 0.25, 0.5 - 0.375])
    assert seen.gaps == pytest.approx([0.5, -0.75])
    assert (seen.comparisons, test.matches_each) == (8, 4)
    decision = decide_matches(replace(test, settings=GATE.compared_with_champion(0.1)), matches)
    assert (decision.blocks, decision.games, len(decision.counts)) == (2, 16, 17)


def test_an_incomplete_round_is_ignored() -> None:
    matches = round_of((1.0, 0.5), (0.0, 0.5))
    for end in range(4):
        assert observe(SequentialTest(GATE, "a", "b", pairs=2), matches[:end]).scores == []


def test_differences_of_returns_are_means_of_a_round() -> None:
    returns = GateConfig(model="returns", return_bound=2, margin=0.5)
    seen = observe(SequentialTest(returns, "a", "b", pairs=2), round_of((1.0, 0.5), (0.0, 0.5)))
    assert seen.gaps == pytest.approx([1.0])
