"""Decisions of a gate on given results: its tests, how they are combined, and what is said about them."""

import re
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.stats import binomtest

from benchmarks.simulations.exploiter_gates import against_anchor
from evaluation.gating.criteria.anchor import AnchorTest
from evaluation.gating.criteria.champion import ChampionTest
from evaluation.gating.criteria.criterion import Contest, Criterion, percent
from evaluation.gating.criteria.exploitability import ExploitabilityTest
from evaluation.gating.criteria.exploiter import ExploiterTest
from evaluation.gating.gate import (
    Decision,
    Outcome,
    SequentialMonitor,
    SequentialTest,
    decide,
    decide_matches,
    decision_bounds,
    observe,
    shadow_shortfall,
)
from evaluation.gating.gate_result import CriterionResult, GateResult
from evaluation.gating.verdicts import open_verdict
from evaluation.matches.game_records import unique_games
from evaluation.statistics.sequential import ELO_PER_EFFECT, bounds, expected_games, gsprt_llr
from league.config.gate import GateConfig
from league.errors import ConfigError
from league.registry.storage.rows import VerdictRow
from league.results.records import GAMES_PER_BLOCK, Game, Match
from tests.support.closeness import close
from tests.support.gate_results import decided
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import STRONG, WEAK, league_of

GATE = GateConfig(elo0=0, elo1=60, max_blocks=400)
LOGISTIC = GateConfig(model="logistic", elo1=40, alpha=0.05, nights=None, max_blocks=4000)
RETURNS = GateConfig(model="returns", return_bound=4, return1=1, margin=0.5, nights=None)
BOT = "script:policy_league.examples.tictactoe_bot:act"


block_scores = st.lists(st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0]), max_size=120)


few_examples = settings(max_examples=60, deadline=None)


CELLS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])


FAIR, FIRST_MOVER_WINS = (0.25, 0.0, 0.5, 0.0, 0.25), (0.08, 0.06, 0.72, 0.06, 0.08)
"""Probabilities of LL, LD, DD or WL, WD, WW between equal players, without and with a first-move advantage."""


def match(contestants: tuple[str, str], scores: Sequence[float], position: int = 0, moves: Sequence[int] = ()) -> Match:
    """A block with these scores of the first contestant, and its returns of -1 to 1."""
    games = tuple(
        Game((i, 1 - i), 1, (position,), tuple(moves), (2 * score - 1, 1 - 2 * score), (score, 1 - score))
        for i, score in enumerate(scores)
    )
    return Match(f"s/{position}", "league", "s", position, contestants, 1, "digest", games)


def matches_with(*scores: Sequence[float]) -> list[Match]:
    """Blocks of a challenger with these scores."""
    return [match(("league@2", "league@1"), pair, position) for position, pair in enumerate(scores)]


def test_a_streak_is_decided_at_a_bound() -> None:
    decision, (lower, upper) = decide(GATE, [1.0] * 400), bounds(0.05, 0.05)
    assert decision.outcome == "promote"
    assert close(decision.bounds, (lower, upper))
    assert decision.curve[-1] == pytest.approx(decision.llr)
    assert decision.llr >= upper > decision.curve[-2]
    assert decision.blocks == len(decision.curve) == decision.games / 2 == decision.counts[4]
    assert decision.score == pytest.approx(1.0)
    assert decision.estimate.elo > 400
    lost = decide(GATE, [0.0] * 400)
    assert (lost.outcome, lost.counts[0]) == ("reject", lost.blocks)
    assert lost.llr <= lower


def test_a_monitor_waits_for_the_blocks_that_must_be_played() -> None:
    matches = matches_with(*[(1.0, 1.0)] * 60)
    decided_at = decide_matches(SequentialTest(GATE, "league@2"), matches).blocks
    assert decided_at < 50
    watch = SequentialMonitor(SequentialTest(GATE, "league@2", at_least=50))
    assert [watch.is_over(matches[:end]) for end in (decided_at - 1, decided_at, 49, 50)] == [False, False, False, True]


def test_an_even_match_is_open_until_it_is_inconclusive_at_max_blocks() -> None:
    settings, scores = GateConfig(elo0=-30, elo1=30, max_blocks=50), [0.0, 1.0] * 50
    assert decide(settings, scores[:49]).outcome is None
    decision = decide(settings, scores)
    assert (decision.outcome, decision.blocks) == ("inconclusive", 50)
    decision = decide(GATE, [])
    assert close((decision.outcome, decision.llr, decision.blocks, decision.games), (None, 0.0, 0, 0))
    assert decision.estimate is decision.score is None


def test_single_games_are_trinomial_and_impossible_scores_rejected() -> None:
    decision = decide(GATE, [1.0, 0.5, 0.0, 1.0], comparisons=1)
    assert decision.counts == (1, 1, 2)
    assert decision.llr == pytest.approx(gsprt_llr((1, 1, 2), 0, 60, "normalized"), abs=1e-9)
    for score in (0.3, -0.25, 1.25):
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
def test_it_stops_at_the_first_decisive_block(scores: list[float], later: list[float]) -> None:
    decision = decide(GATE, scores)
    lower, upper = decision.bounds
    assert all(lower < llr < upper for llr in decision.curve[:-1])
    assert decide(GATE, scores[: decision.blocks - 1]).outcome is None or decision.blocks == 0
    if decision.outcome is not None:
        assert close(decide(GATE, scores + later), decision)
        assert close(decide(GATE, scores[: decision.blocks]), decision)


@few_examples
@given(block_scores, st.lists(st.integers(1, 40), min_size=1))
def test_monitoring_chunks_equals_deciding_all_matches(scores: list[float], sizes: list[int]) -> None:
    """For any chunks, the monitor stops in the chunk with the stopping block."""
    matches = matches_with(*((min(1.0, 2 * s), max(0.0, 2 * s - 1)) for s in scores))
    expected = decide_matches(SequentialTest(GATE, "league@2"), matches)
    monitor, number = SequentialMonitor(SequentialTest(GATE, "league@2")), 0
    over = monitor.is_over([])
    assert not over
    while not over and number < len(matches):
        number += sizes[number % len(sizes)]
        over = monitor.is_over(matches[:number])
    assert over == (expected.outcome is not None)
    assert close(decide_matches(SequentialTest(GATE, "league@2"), matches[:number]), expected)


def test_the_challenger_can_be_either_contestant_and_repeated_games_count_once() -> None:
    matches = matches_with(*[(1.0, 1.0)] * 60)
    assert decide_matches(SequentialTest(GATE, "league@2"), matches).outcome == "promote"
    assert decide_matches(SequentialTest(GATE, "league@1"), matches).outcome == "reject"
    pair, even = ("league@2", "league@1"), (1.0, 0.0)
    repeated = [match(pair, even, 7, (1, 2)), match(pair, even, 7, (1, 2))]
    assert unique_games(repeated) == 1
    assert unique_games([*repeated, match(pair, even, 8, (1, 2)), match(pair, even, 7, (1, 3))]) == 3
    assert decide_matches(SequentialTest(GATE, "league@2"), repeated).unique_games == 1


@pytest.mark.parametrize("shares", [FAIR, pytest.param(FIRST_MOVER_WINS, marks=pytest.mark.slow)])
def test_error_probabilities_and_lengths_are_those_of_the_hypotheses(shares: tuple[float, ...]) -> None:
    """Of 2,000 simulated gates, at most 5 % are wrong, plus three binomial standard errors: between equal players, and
    with probabilities that are tilted to an effect of 60 normalized Elo per game.
    """
    tolerance = 3 * np.sqrt(0.05 * 0.95 / 2000)
    for elo, cells in ((0, np.array(shares)), (60, _tilted(np.array(shares), 60))):
        promoted, blocks = _simulate(cells, 2000, seed=1 + bool(elo))
        assert (1 - promoted if elo else promoted) <= 0.05 + tolerance
        assert blocks * 2 == pytest.approx(expected_games(0, 60, elo, 0.05, 0.05), rel=0.15)


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


@pytest.mark.slow
@pytest.mark.parametrize("improvement", [0.0, 0.2])
def test_the_paired_test_keeps_its_error_probabilities(improvement: float) -> None:
    """500 gates whose candidate scores `gap` more: H0 is rarely accepted as H1, and H1 rarely as H0."""
    settings = GateConfig(alpha=0.05, beta=0.05, max_blocks=300).of_exploitability(0.2, improvement)
    for gap, wrong_outcome in ((improvement - 0.2, "promote"), (improvement, "reject")):
        rng, wrong, limit = np.random.default_rng(5), 0, 0.05
        for _ in range(500):
            opening = rng.uniform(0.3, 0.7, size=(300, 1))
            candidate, champion = (rng.binomial(4, np.clip(opening + shift, 0, 1))[:, 0] / 4 for shift in (gap, 0.0))
            outcome = decide(settings, ((1 + candidate - champion) / 2).tolist(), comparisons=4).outcome
            wrong += outcome == wrong_outcome
        assert wrong / 500 <= limit + 2 * (limit * (1 - limit) / 500) ** 0.5


def test_a_comparison_against_an_anchor_keeps_its_error_rates() -> None:
    """The anchor is stronger than all versions. `benchmarks.calibration` measures more cases."""
    settings = GateConfig(alpha=0.05, nights=None).compared_with_champion(0.1)
    worse, equal = (against_anchor(settings, 0.22, gap, 0.0, gates=300, seed=1) for gap in (-0.1, 0.0))
    assert binomtest(int(worse.promoted.sum()), 300).proportion_ci(0.99).low <= 0.05
    assert binomtest(int(equal.promoted.sum()), 300).proportion_ci(0.99).high >= 0.95


def round_of(own: tuple[float, ...], other: tuple[float, ...]) -> list[Match]:
    """A round in which candidate and champion have these scores against their exploiters."""
    pairs = zip(own, other, strict=True)
    return [
        match((who, f"{who}-{i}"), (s, s)) for i, both in enumerate(pairs) for who, s in zip("ab", both, strict=True)
    ]


def test_a_round_is_one_observation_of_means() -> None:
    matches = [*round_of((1.0, 0.5), (0.0, 0.5)), *round_of((0.0, 0.0), (1.0, 0.5))]
    test = SequentialTest(GateConfig(), "a", "b", pairs=2)
    observations = observe(test, matches)
    assert observations.scores == pytest.approx([0.5 + 0.25, 0.5 - 0.375])
    assert observations.gaps == pytest.approx([0.5, -0.75])
    assert (observations.comparisons, test.matches_each) == (8, 4)
    decision = decide_matches(replace(test, settings=GateConfig().compared_with_champion(0.1)), matches)
    assert (decision.blocks, decision.games, len(decision.counts)) == (2, 16, 17)
    assert [observe(test, matches[:end]).scores for end in range(4)] == [[]] * 4, "an incomplete round is ignored"
    returns = replace(test, settings=GateConfig(model="returns", return_bound=2, margin=0.5))
    assert observe(returns, matches[:4]).gaps == pytest.approx([2.0])


def test_equal_results_in_every_pair_pass_and_half_of_a_difference_of_returns_is_tested() -> None:
    assert decide(GateConfig().compared_with_champion(0.1), [0.5] * 200, comparisons=4).outcome == "promote"
    gate = GateConfig(model="returns", return_bound=4, margin=1)
    for tested, hypotheses in {
        gate.compared_with_champion(0.6): (-0.3, 0.0),
        gate.of_exploitability(0.6): (-0.3, 0.0),
        gate.of_exploitability(0.6, improvement=0.4): (0.0, 0.2),
    }.items():
        assert (tested.return0, tested.return1) == hypotheses
    for differences, outcome in (([0.2, 0.3], "promote"), ([0.0, -0.1], "reject")):
        assert decide(gate.of_exploitability(0.6, 0.4), [0.5] * 400, 4, differences * 200).outcome == outcome


def test_a_shadow_requirement_needs_enough_evidence() -> None:
    gate = GateConfig(shadow_agreement=0.9, latency_ms=2.0, shadow_observations=100)
    for observed, reason in (
        ((99, 0, 1.0, 0.1), "99 observations .* requires 100"),
        ((0, 0, None, None), "has 0 observations"),
        ((100, 0, 0.899, 2.0), "on 89.9 % of 100 observations, .* 90.0 %"),
        ((100, 0, 1.0, 5.0), "within 5 ms, .* 2 ms"),
        ((100, 1, 1.0, 0.1), "failed to answer 1 requests"),
    ):
        assert re.search(reason, str(shadow_shortfall(gate, *observed)))
    assert shadow_shortfall(gate, 100, 0, 0.9, 2.0) is None
    assert shadow_shortfall(GateConfig(), 0, 0, None, None) is None
    assert shadow_shortfall(GateConfig(shadow_agreement=0.5), 1000, 0, 0.6, 99.0) is None
    assert shadow_shortfall(GateConfig(latency_ms=1), 1000, 0, 0.0, 0.5) is None


def test_a_first_champion_must_be_stronger_than_the_baseline() -> None:
    returns = {"model": "returns", "return_bound": 4, "margin": 1}
    for document, expected in (
        ({"elo0": 0, "elo1": 30}, (0, 30)),
        ({"elo0": -50, "elo1": 0}, (0, 50)),
        ({"elo0": -50, "elo1": 80}, (0, 80)),
        (returns | {"return0": -0.25}, (0, 0.25)),
        (returns | {"return1": 0.5}, (0, 0.5)),
    ):
        gate = GateConfig(**document).against_baseline()
        assert ((gate.return0, gate.return1) if gate.model == "returns" else (gate.elo0, gate.elo1)) == expected
        assert gate.requires_gain


def test_an_invalid_gate_is_rejected() -> None:
    for gate, message in (
        ({"elo1": 400}, "elo1"),
        ({"anchors": ["script:bots:"]}, "gate.anchors.*my_package.module:name"),
        ({"anchors": [{"ref": "script:random", "margin": 300}]}, "margins must lie within ±190"),
        ({"anchors": [{"ref": "script:random", "margins": 3}]}, "did you mean 'margin'"),
        ({"anchors": [{"ref": BOT, "mode": "no_worse", "margin": 50}]}, r"anchors\[0\]\.margin must be smaller than 1"),
        ({"anchors": [{"ref": BOT, "mode": "best"}]}, "expected 'no_worse' or 'at_least', got 'best'"),
        ({"margin": 0}, "gate.margin"),
        ({"model": "returns"}, "return_bound"),
        ({"model": "returns", "return_bound": 2}, "margin, which is a return with model: returns, must be smaller"),
        ({"model": "returns", "return_bound": 200, "return0": 3, "return1": 2}, "return0 first"),
        ({"nights": 0}, "gate.nights"),
        ({"exploiter_margin": 1.5}, r"exploiter_margin must be smaller than 1 \(all points\), got 1.5"),
        (
            {"model": "returns", "return_bound": 2, "margin": 1, "exploiter_margin": 4},
            r"smaller than 4 \(twice return_bound\)",
        ),
        (
            {"exploiters": {"count": 1, "improvement": 1}},
            r"exploiters.improvement must be smaller than 1 \(all points\), got 1",
        ),
        ({"exploiters": {"improvement": 0.1}}, "exploiters.improvement requires exploiters.count"),
    ):
        with pytest.raises(ConfigError, match=message):
            tictactoe.config(gate=gate)


def test_the_default_mode_and_margin_depend_on_the_anchor() -> None:
    for anchor, expected in (
        ("script:one_ply", ("no_worse", 0.1)),
        (BOT, ("no_worse", 0.1)),
        ("https://models.example.org/v2/models/solver", ("no_worse", 0.1)),
        ("@gold", ("at_least", 50)),
        ("tictactoe@3", ("at_least", 50)),
        ({"ref": BOT, "margin": 40}, ("at_least", 40)),
        ({"ref": BOT, "mode": "at_least"}, ("at_least", 50)),
        ({"ref": BOT, "mode": "no_worse", "margin": 0.02}, ("no_worse", 0.02)),
        ({"ref": "@3", "mode": "no_worse"}, ("no_worse", 0.1)),
    ):
        gate = tictactoe.config(gate={"anchors": [anchor]}).gate
        assert (gate.anchors[0].tested_mode, gate.margin_of(gate.anchors[0])) == expected
    gate = tictactoe.config(gate={"anchors": [BOT], "model": "returns", "return_bound": 4, "margin": 0.5}).gate
    assert gate.margin_of(gate.anchors[0]) == 0.5, "in returns, which the gate tests"


EVEN_COUNTS = (10, 20, 40, 20, 10)


def decision(outcome: Outcome | None, llr: float = 3.0) -> Decision:
    blocks = sum(EVEN_COUNTS)
    return Decision(outcome, llr, decision_bounds(LOGISTIC), blocks, 2 * blocks, None, EVEN_COUNTS, (), None)


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
    return GateResult(LOGISTIC, first, tuple(results), number, forfeits)


outcomes = st.sampled_from((None, *get_args(Outcome)))


@given(outcomes, st.lists(outcomes, max_size=4), st.integers(0, 3))
def test_a_promotion_needs_all_tests(champion: Outcome | None, further: list[Outcome | None], forfeits: int) -> None:
    result = gate_result(champion, *further, forfeits=forfeits)
    passed = champion == "promote" and not forfeits and all(outcome == "promote" for outcome in further)
    assert (result.outcome == "promote") == passed
    if champion == "promote" and result.outcome not in (None, "promote"):
        assert result.note


@given(outcomes.filter(lambda outcome: outcome != "promote"))
def test_the_test_against_the_champion_decides_unless_it_is_passed(champion: Outcome | None) -> None:
    result = gate_result(champion, planned=2)
    assert (result.outcome, result.note) == (champion, None)


def test_a_test_that_is_not_passed_is_named() -> None:
    result = gate_result("promote", "promote", "reject", "promote")
    assert (result.outcome, result.note) == ("reject", "it beat the champion, but is weaker than l@1")
    result = gate_result("promote", "inconclusive")
    note = "it beat the champion, but 200 games do not show that it is at most 50 weaker than l@1"
    assert (result.outcome, result.note) == ("inconclusive", note)
    assert gate_result("promote", "promote", planned=2).outcome is None, "one was not started"


def test_shares_that_are_compared_have_the_decimals_that_tell_them_apart() -> None:
    assert (percent(0.5), percent(0.5, 0.5), percent(0.5, None, 0.51)) == ("50.0 %",) * 3
    assert (percent(0.5, 0.50004), percent(0.50004, 0.5)) == ("50.000 %", "50.004 %")
    assert percent(0.5, 0.5 + 1e-9) == "50.0000 %"


def test_each_outcome_has_its_reason_and_remedy() -> None:
    assert gate_result("promote").reason("promote", True, None) == (
        "Stronger: after 200 games, the LLR was 3.00, above the bound of 2.94. It scored 50.0 % against l@2."
    )
    rejected = gate_result("reject", llr=-3.0)
    assert rejected.reason("reject", False, None).startswith("Not stronger: after 200 games, the LLR was −3.00, below")
    assert rejected.remedy("reject", False) == "To pass, it must do better."
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
    for llr, expected in (
        (1.5, "At this rate, it passes after about 400 games (gate.max_blocks: 200, now 4000); fewer with a larger"),
        (-1.5, "More games would rather reject it, after about 400 games (gate.max_blocks: 200)."),
        (0.0, "about halfway between the hypotheses, so that more games hardly help: set a larger margin"),
        (1e-5, "about halfway between the hypotheses"),
    ):
        for result in (gate_result("inconclusive", llr=llr), gate_result("promote", "inconclusive", llr=llr)):
            assert expected in str(result.remedy("inconclusive", False))


CANDIDATE, CHAMPION = "l@3", "l@2"
FIRST = ChampionTest(schedule="s")
ANCHOR = AnchorTest(ref=BOT, margin=0.1, schedule="s", mode="no_worse")
EXPLOITER = ExploiterTest(ref="l@7", exploits="l@1", margin=0.1, schedule="s")
WON, LOST, EVEN = (1.0, 1.0), (0.0, 0.0), (1.0, 0.0)


def against(opponent: str, *blocks: Sequence[float], number: int = 200) -> list[Match]:
    return [match((CANDIDATE, opponent), scores) for _ in range(number) for scores in blocks]


def rounds(candidate: Sequence[float], champion: Sequence[float], number: int = 200, pairs: int = 1) -> list[Match]:
    """Blocks of candidate and champion in turn, each against its own opponents."""
    return [
        match((contestant, f"{contestant}-exploiter-{pair}"), scores)
        for _ in range(number)
        for pair in range(pairs)
        for contestant, scores in ((CANDIDATE, candidate), (CHAMPION, champion))
    ]


def result_of(test: Criterion, matches: list[Match], gate: GateConfig = LOGISTIC) -> CriterionResult:
    """These kinds read neither the registry nor the ledger."""
    nothing: Any = None
    row = VerdictRow(
        id="l-verdict-1",
        league="l",
        candidate=3,
        champion=CHAMPION,
        settings={"gate": gate.model_dump(mode="json")},
        outcome=None,
        evidence=None,
        opened_at=datetime.now(UTC),
        closed_at=None,
    )
    contest = Contest(nothing, nothing, row, nothing, gate, CANDIDATE, CHAMPION, "the champion")
    return test.result(contest, matches)


def test_the_test_against_the_champion_names_both_scores_and_the_score_that_is_needed() -> None:
    result = result_of(FIRST, against(CHAMPION, WON))
    assert (result.decision.outcome, result.passed) == ("promote", "beat the champion")
    assert result.scores == "It scored 100.0 % against l@2, which scored 0.0 %."
    assert len(result.decision.counted) == result.decision.blocks < 200
    result = result_of(FIRST, against(CHAMPION, LOST, EVEN))
    assert result.decision.outcome == "reject"
    assert "To pass, it must score more than about 52.9 % against l@2" in result.requirement
    assert result.requirement.endswith("(gate.elo0: 0, gate.elo1: 40).")
    assert result.wider == "gate.elo0 and gate.elo1 that are further apart"
    without_gain = GateConfig(model="logistic", elo0=-2000, elo1=-1500, nights=None)
    assert result_of(FIRST, against(CHAMPION, LOST), without_gain).passed == "is not inferior to the champion"


def test_the_score_that_is_needed_depends_on_the_deviation_with_normalized_elo() -> None:
    needed, normalized = [], LOGISTIC.model_copy(update={"model": "normalized"})
    for blocks in ((WON, EVEN, EVEN, LOST), (EVEN, EVEN, EVEN, EVEN, (1.0, 0.5), (0.5, 0.0))):
        requirement = result_of(FIRST, against(CHAMPION, *blocks, number=4), normalized).requirement
        needed.append(float(requirement.split("about ")[1].split(" %")[0]))
    assert needed[0] > needed[1] > 50


def test_with_returns_the_bar_is_a_difference_of_returns() -> None:
    assert "exceed those of l@2 by more than about 0.5" in result_of(FIRST, [], RETURNS).requirement
    assert "at most about 0.05 in returns worse" in result_of(ANCHOR, rounds(LOST, EVEN), RETURNS).requirement
    test = ExploitabilityTest(margin=0.5, schedule="s", of_candidate=("a",), of_champion=("b",), blocks=300)
    report = result_of(test, rounds(LOST, WON), RETURNS).report
    assert report.finding.startswith("more exploitable than l@2 by 0.5 in returns after ")


def test_a_paired_test_compares_with_the_champion() -> None:
    of_anchor = (ANCHOR, BOT, "margin of the anchor: 0.1")
    for test, opponent, setting in (of_anchor, (EXPLOITER, "l@7, an exploiter of l@1", "gate.exploiter_margin: 0.1")):
        ref = opponent.partition(",")[0]
        result = result_of(test, rounds(LOST, EVEN))
        assert result.decision.outcome == "reject"
        assert result.failed == f"does worse than the champion against {opponent}"
        assert result.scores == f"Against {ref} it scored 0.0 %, and l@2 50.0 %."
        assert result.requirement == f"To pass, it must score more than about 45.0 % against {ref} ({setting})."
        assert result.wider == f"a larger {setting}"
        report: Any = result.report
        assert (report.score, report.champion_score, report.difference.mean) == (0.0, 0.5, -0.5)
        expected = f"against {ref} worse than l@2 by 0.1 of all points after {report.games} games"
        assert (report.outcome, report.finding) == ("worse", expected)
        better = result_of(test, rounds(WON, EVEN))
        assert better.passed == f"is at most 0.1 worse than the champion against {opponent}"
        assert better.report.outcome == "not worse"
    report = result_of(EXPLOITER, rounds(EVEN, EVEN, number=1)).report
    assert (report.outcome, report.finding) == ("open", "against l@7 open compared with l@2 after 4 games")


@pytest.mark.parametrize(
    ("improvement", "candidate", "outcome", "margin"),
    [
        (0.0, WON, "not more exploitable", " by 0.1 of all points"),
        (0.0, LOST, "more exploitable", " by 0.1 of all points"),
        (0.2, WON, "less exploitable", ""),
        (0.2, LOST, "not less exploitable", " by 0.2 of all points"),
    ],
)
def test_a_comparison_of_exploitability(
    improvement: float, candidate: Sequence[float], outcome: str, margin: str
) -> None:
    """That a candidate is less exploitable shows a difference of any size."""
    refs = {ref: tuple(f"{ref}-exploiter-{pair}" for pair in range(2)) for ref in (CANDIDATE, CHAMPION)}
    test = ExploitabilityTest(
        margin=0.1,
        improvement=improvement,
        schedule="s",
        of_candidate=refs[CANDIDATE],
        of_champion=refs[CHAMPION],
        blocks=150,
    )
    result = result_of(test, rounds(candidate, EVEN, pairs=2))
    report: Any = result.report
    assert report.outcome == outcome
    expected = f"{outcome} than l@2{margin} after {report.games} games: a best response scores at least "
    assert report.finding.startswith(expected)
    if candidate == LOST:
        assert result.decision.outcome == "reject"
        assert result.failed == f"is {outcome} than l@2 by exploiters trained against each"
    assert result.scores == f"Against its exploiters it scored {100 * candidate[0]:.1f} %, and l@2 50.0 %."
    limit = (
        "must achieve at least about 0.1 of all points less"
        if improvement
        else "may achieve at most about 0.05 of all points more"
    )
    assert result.requirement.startswith(f"To pass, exploiters {limit} against it than against l@2 (gate.exploiter")
    assert {score.games for score in report.candidate.exploiters} == {300}
    assert report.difference.mean == pytest.approx(0.5 - candidate[0])


def test_exploitability_is_estimated_from_a_fixed_number_of_rounds_only() -> None:
    test = ExploitabilityTest(margin=0.1, schedule="s", of_candidate=("a",), of_champion=("b",), blocks=201)
    result = result_of(test, rounds(LOST, WON))
    report: Any = result.report
    assert (report.candidate, report.difference, result.scores) == (None, None, None)
    assert report.finding.endswith("games")


def test_an_anchor_names_what_the_champion_scored_in_other_games(tmp_path: Path) -> None:
    registry = league_of(tmp_path, WEAK, STRONG)
    contest = Contest.of(registry, open_verdict(registry, registry.leagues.get("tictactoe"), 2, "script:random"))
    for ref in ("script:one_ply", "tictactoe@1"):
        test = AnchorTest(ref=ref, margin=50.0, schedule="s", mode="at_least")
        result = test.result(contest, [match(("tictactoe@2", ref), LOST)] * 300)
        assert (result.failed, result.report.outcome) == (f"is weaker than {ref}", "inferior")
        assert result.report.finding == f"inferior to {ref} by 50 Elo after {result.decision.games} games"
        assert result.scores == (
            f"Against {ref} it scored 0.0 % in {result.decision.games} games; script:random has not played it."
        )
        hint = " With mode: no_worse, it need only do as well as the champion there."
        assert result.requirement.endswith("(margin of the anchor: 50)." + hint * (ref == "script:one_ply"))


def test_a_recorded_test_is_read_as_it_was_written() -> None:
    for test in (
        ANCHOR,
        EXPLOITER,
        ExploitabilityTest(margin=0.1, schedule=None, blocks=20, improvement=0.1),
        ExploitabilityTest(margin=0.1, schedule="s", of_candidate=("l@4",), of_champion=("l@5",), blocks=20),
    ):
        record = test.to_record()
        assert record["kind"] == test.kind
        assert type(test).of_record(record) == test
