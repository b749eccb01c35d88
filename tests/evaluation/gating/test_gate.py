import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from evaluation.gating.gate import SequentialMonitor, SequentialTest, decide, decide_matches, observe, shadow_shortfall
from evaluation.matches.game_records import unique_games
from evaluation.statistics.sequential import ELO_PER_EFFECT, bounds, expected_games, gsprt_llr
from league.config.gate import GateConfig
from league.results.records import GAMES_PER_BLOCK, Game, Match
from tests.support.closeness import close

GATE = GateConfig(elo0=0, elo1=60, max_blocks=400)
block_scores = st.lists(st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0]), max_size=120)
few_examples = settings(max_examples=60, deadline=None)

CELLS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])

FAIR, FIRST_MOVER_WINS = (0.25, 0.0, 0.5, 0.0, 0.25), (0.08, 0.06, 0.72, 0.06, 0.08)
"""Probabilities of LL, LD, DD or WL, WD, WW between equal players, without and with a first-move advantage."""
equal_players = pytest.mark.parametrize(
    "shares",
    [
        pytest.param(FAIR, id="fair"),
        pytest.param(FIRST_MOVER_WINS, id="first mover wins", marks=pytest.mark.slow),
    ],
)


def match(position: int, points: Sequence[float], moves: Sequence[int] = (0,)) -> Match:
    """A block of two games with these scores of the challenger."""
    games = tuple(Game((i, 1 - i), 1, (position,), tuple(moves), (p, 1 - p), (p, 1 - p)) for i, p in enumerate(points))
    return Match(f"s/{position}", "league", "s", position, ("league@2", "league@1"), 1, "digest", games)


def test_a_winning_streak_is_promoted_at_the_upper_bound() -> None:
    decision = decide(GATE, [1.0] * 400)
    lower, upper = bounds(0.05, 0.05)
    assert decision.outcome == "promote"
    assert close(decision.bounds, (lower, upper))
    assert decision.curve[-1] == pytest.approx(decision.llr)
    assert decision.llr >= upper > decision.curve[-2]
    assert decision.blocks == len(decision.curve) == decision.games / 2 == decision.counts[4]
    assert decision.score == pytest.approx(1.0)
    assert decision.estimate is not None
    assert decision.estimate.elo > 400


def test_a_monitor_waits_for_the_blocks_that_must_be_played() -> None:
    matches = [match(position, (1.0, 1.0)) for position in range(60)]
    decided = decide_matches(SequentialTest(GATE, "league@2"), matches).blocks
    assert decided < 50
    watch = SequentialMonitor(SequentialTest(GATE, "league@2", at_least=50))
    assert [watch.is_over(matches[:end]) for end in (decided - 1, decided, 49, 50)] == [False, False, False, True]


def test_a_losing_streak_is_rejected_at_the_lower_bound() -> None:
    decision = decide(GATE, [0.0] * 400)
    assert decision.outcome == "reject"
    assert decision.llr <= decision.bounds[0]
    assert decision.counts[0] == decision.blocks


def test_an_even_match_is_inconclusive_at_max_blocks() -> None:
    settings = GateConfig(elo0=-30, elo1=30, max_blocks=50)
    scores = [0.0, 1.0] * 50
    assert decide(settings, scores[:49]).outcome is None
    decision = decide(settings, scores)
    assert (decision.outcome, decision.blocks) == ("inconclusive", 50)


def test_without_blocks_the_decision_is_open() -> None:
    decision = decide(GATE, [])
    assert close((decision.outcome, decision.llr, decision.blocks, decision.games), (None, 0.0, 0, 0))
    assert decision.estimate is decision.score is None


def test_single_games_are_trinomial() -> None:
    decision = decide(GATE, [1.0, 0.5, 0.0, 1.0], comparisons=1)
    assert decision.counts == (1, 1, 2)
    assert decision.llr == pytest.approx(gsprt_llr((1, 1, 2), 0, 60, "normalized"), abs=1e-9)


@pytest.mark.parametrize("score", [0.3, -0.25, 1.25])
def test_impossible_block_scores_are_rejected(score: float) -> None:
    with pytest.raises(ValueError, match="multiples"):
        decide(GATE, [0.5, score])


def test_the_llr_of_a_block_does_not_depend_on_later_ones() -> None:
    rng = np.random.default_rng(0)
    scores = rng.choice([0.0, 0.25, 0.5, 0.75, 1.0], size=400, p=[0.25, 0.3, 0.2, 0.15, 0.1]).tolist()
    settings = GATE.model_copy(update={"max_blocks": 400, "alpha": 1e-9})
    every = decide(settings, scores).curve
    for blocks in (5, 11, 50, 200):
        assert decide(settings, scores[:blocks]).curve == pytest.approx(every[:blocks], rel=1e-13)


@few_examples
@given(block_scores, block_scores)
def test_blocks_after_the_stopping_block_are_ignored(scores: list[float], later: list[float]) -> None:
    decision = decide(GATE, scores)
    if decision.outcome is not None:
        assert close(decide(GATE, scores + later), decision)
        assert close(decide(GATE, scores[: decision.blocks]), decision)


@few_examples
@given(block_scores)
def test_it_stops_at_the_first_decisive_block(scores: list[float]) -> None:
    decision = decide(GATE, scores)
    lower, upper = decision.bounds
    assert all(lower < llr < upper for llr in decision.curve[:-1])
    assert decide(GATE, scores[: decision.blocks - 1]).outcome is None or decision.blocks == 0


@few_examples
@given(block_scores, st.lists(st.integers(1, 40), min_size=1))
def test_monitoring_chunks_equals_deciding_all_matches(scores: list[float], sizes: list[int]) -> None:
    """For any chunks, the monitor stops in the chunk with the stopping block."""
    matches = [match(i, (min(1.0, 2 * s), max(0.0, 2 * s - 1))) for i, s in enumerate(scores)]
    expected = decide_matches(SequentialTest(GATE, "league@2"), matches)
    monitor, seen = SequentialMonitor(SequentialTest(GATE, "league@2")), 0
    over = monitor.is_over([])
    assert not over
    while not over and seen < len(matches):
        seen += sizes[seen % len(sizes)]
        over = monitor.is_over(matches[:seen])
    assert over == (expected.outcome is not None)
    assert close(decide_matches(SequentialTest(GATE, "league@2"), matches[:seen]), expected)


def test_the_challenger_can_be_either_contestant() -> None:
    matches = [match(i, (1.0, 1.0)) for i in range(60)]
    assert decide_matches(SequentialTest(GATE, "league@2"), matches).outcome == "promote"
    assert decide_matches(SequentialTest(GATE, "league@1"), matches).outcome == "reject"


def test_repeated_games_are_counted_once() -> None:
    repeated = [match(7, (1.0, 0.0), moves=(1, 2)), match(7, (1.0, 0.0), moves=(1, 2))]
    assert unique_games(repeated) == 1
    assert unique_games([*repeated, match(8, (1.0, 0.0), moves=(1, 2)), match(7, (1.0, 0.0), moves=(1, 3))]) == 3
    assert decide_matches(SequentialTest(GATE, "league@2"), repeated).unique_games == 1


@equal_players
def test_equal_players_are_rarely_promoted(shares: tuple[float, ...]) -> None:
    """Of 2,000 simulated gates, at most 5 % are false promotions, plus three binomial standard errors."""
    promoted, blocks = _simulate(np.array(shares), 2000, seed=1)
    assert promoted <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / 2000)
    assert blocks * 2 == pytest.approx(expected_games(0, 60, 0, 0.05, 0.05), rel=0.15)


@equal_players
def test_a_challenger_at_h1_is_mostly_promoted(shares: tuple[float, ...]) -> None:
    """Probabilities between equal players, tilted to an effect of 60 normalized Elo per game."""
    stronger = _tilted(np.array(shares), 60)
    promoted, blocks = _simulate(stronger, 2000, seed=2)
    assert promoted >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 2000)
    assert blocks * 2 == pytest.approx(expected_games(0, 60, 60, 0.05, 0.05), rel=0.15)


def _tilted(shares: np.ndarray, elo: float) -> np.ndarray:
    def distance(theta: float) -> float:
        weights = _weighted(shares, theta)
        mean = weights @ CELLS
        effect = (mean - 0.5) / np.sqrt(GAMES_PER_BLOCK * weights @ (CELLS - mean) ** 2)
        return float(ELO_PER_EFFECT * effect - elo)

    return _weighted(shares, brentq(distance, -3, 3))


def _weighted(shares: np.ndarray, theta: float) -> np.ndarray:
    weighted = shares * np.exp(theta * CELLS)
    return np.asarray(weighted / weighted.sum())


def _simulate(shares: np.ndarray, gates: int, seed: int) -> tuple[float, float]:
    """Fraction of promotions, and mean number of blocks, of gates over random block scores.

    All gates are simulated block by block; the result of a sample is compared with `decide`.
    """
    rng = np.random.default_rng(seed)
    lower, upper = bounds(GATE.alpha, GATE.beta)
    drawn = rng.choice(5, p=shares, size=(gates, GATE.max_blocks))
    counts, ends, llrs = np.zeros((gates, 5)), np.full(gates, GATE.max_blocks), np.zeros(gates)
    running = np.arange(gates)
    for start in range(0, GATE.max_blocks, 40):
        steps = np.eye(5)[drawn[running, start : start + 40]].cumsum(axis=1) + counts[running, None]
        curves = gsprt_llr(steps, GATE.elo0, GATE.elo1, GATE.model)
        outside = (curves <= lower) | (curves >= upper)
        ended = outside.any(axis=1)
        at = outside.argmax(axis=1)[ended]
        ends[running[ended]], llrs[running[ended]] = start + at + 1, curves[ended, at]
        counts[running] = steps[:, -1]
        running = running[~ended]
    for gate in range(0, gates, gates // 20):
        decision = decide(GATE, list(CELLS[drawn[gate]]))
        assert decision.blocks == ends[gate]
        assert (decision.outcome == "promote") == (llrs[gate] >= upper)
    return float((llrs >= upper).mean()), float(ends.mean())


SHADOW_GATE = GateConfig(shadow_agreement=0.9, latency_ms=2.0, shadow_observations=100)


@pytest.mark.parametrize(
    ("observed", "reason"),
    [
        ((100, 0, 0.9, 2.0), None),
        ((99, 0, 1.0, 0.1), "99 observations .* requires 100"),
        ((0, 0, None, None), "has 0 observations"),
        ((100, 0, 0.899, 2.0), "on 89.9 % of 100 observations, .* 90.0 %"),
        ((100, 0, 1.0, 5.0), "within 5 ms, .* 2 ms"),
        ((100, 1, 1.0, 0.1), "failed to answer 1 requests"),
    ],
)
def test_a_shadow_requirement_needs_enough_evidence(observed: tuple[Any, ...], reason: str | None) -> None:
    shortfall = shadow_shortfall(SHADOW_GATE, *observed)
    assert shortfall is None if reason is None else re.search(reason, str(shortfall))


def test_without_requirements_there_is_no_shortfall() -> None:
    assert shadow_shortfall(GateConfig(), 0, 0, None, None) is None


def test_each_requirement_is_independent() -> None:
    assert shadow_shortfall(GateConfig(shadow_agreement=0.5), 1000, 0, 0.6, 99.0) is None
    assert shadow_shortfall(GateConfig(latency_ms=1), 1000, 0, 0.0, 0.5) is None


def block(contestants: tuple[str, str], score: float) -> Match:
    """A block in which the first contestant has this score in both games."""
    games = tuple(Game((i, 1 - i), 1, (), (), (score, -score), (score, 1 - score)) for i in (0, 1))
    return Match("s/0", "league", "s", 0, contestants, 1, "digest", games)


def round_of(own: tuple[float, ...], other: tuple[float, ...]) -> list[Match]:
    """A round in which candidate and champion have these scores against their exploiters."""
    pairs = zip(own, other, strict=True)
    return [block((who, f"{who}-{i}"), s) for i, both in enumerate(pairs) for who, s in zip("ab", both, strict=True)]


def test_a_round_is_one_observation_of_mean_scores() -> None:
    matches = [*round_of((1.0, 0.5), (0.0, 0.5)), *round_of((0.0, 0.0), (1.0, 0.5))]
    test = SequentialTest(GateConfig(), "a", "b", pairs=2)
    observations = observe(test, matches)
    assert observations.scores == pytest.approx([0.5 + 0.25, 0.5 - 0.375])
    assert observations.gaps == pytest.approx([0.5, -0.75])
    assert (observations.comparisons, test.matches_each) == (8, 4)
    decision = decide_matches(replace(test, settings=GateConfig().compared_with_champion(0.1)), matches)
    assert (decision.blocks, decision.games, len(decision.counts)) == (2, 16, 17)


def test_an_incomplete_round_is_ignored() -> None:
    matches = round_of((1.0, 0.5), (0.0, 0.5))
    for end in range(4):
        assert observe(SequentialTest(GateConfig(), "a", "b", pairs=2), matches[:end]).scores == []


def test_differences_of_returns_are_means_of_a_round() -> None:
    returns = GateConfig(model="returns", return_bound=2, margin=0.5)
    observations = observe(SequentialTest(returns, "a", "b", pairs=2), round_of((1.0, 0.5), (0.0, 0.5)))
    assert observations.gaps == pytest.approx([1.0])
