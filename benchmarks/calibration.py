"""Do verdicts have their nominal error rates? Simulations of gates, years, anchors and intervals, and gates with real
games.

Each part prints measured values beside their targets. All parts are seeded, so that the numbers are reproducible on any
machine.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from benchmarks.simulations import coverage, exploiter_gates, golden, null_play, sampled_play
from benchmarks.simulations.shuffled_order import verdicts_of_shuffled_completion
from benchmarks.simulations.simulated_gates import CELLS, EQUALS, simulate, stronger
from benchmarks.simulations.simulated_years import boundary, chance, walk
from evaluation.gating.gate import Decision, decide
from evaluation.gating.gate_result import AnchorResult, combine_results
from evaluation.statistics.alpha_spending import NIGHTS, alpha_per_verdict
from evaluation.statistics.sequential import expected_games
from league.config.gate import GateConfig
from league.verdict_tests import AnchorTest
from tests.support.leagues import tictactoe

CANDIDATES = 8
SINGLE = GateConfig(elo0=0, elo1=60, max_blocks=1000, nights=None)


def gates(quick: bool) -> bool:
    """20,000 gates for each hypothesis and three kinds of games."""
    met = [_simulated(kind, shares, quick) for kind, shares in EQUALS.items()]
    return all(met)


def _simulated(kind: str, shares: tuple[float, ...], quick: bool) -> bool:
    """Gates of games with these shares of the cells between equal players."""
    number = 1_000 if quick else 20_000
    theory = expected_games(SINGLE.elo0, SINGLE.elo1, SINGLE.elo0, SINGLE.alpha, SINGLE.beta)
    null = simulate(SINGLE, np.asarray(shares), number, seed=1)
    better = simulate(SINGLE, stronger(shares, SINGLE.elo1), number, seed=2)
    false, high = null.promoted.mean(), _high(int(null.promoted.sum()), number)
    lengths = [2 * float(each.blocks.mean()) / theory for each in (null, better)]
    print(
        f"  {kind}: {number} gates at H0: {false:.2%} promoted, upper 95 % bound {high:.2%} (≤ 5 %, ≤ 5.3 %);"
        f" at H1: {better.promoted.mean():.2%} (≥ 95 %); mean length {lengths[0]:.3f}× and {lengths[1]:.3f}×"
        f" of the {theory:.0f} games of theory (within 10 %)"
    )
    return bool(high <= 0.053 and better.promoted.mean() >= 0.95 and all(abs(each - 1) <= 0.1 for each in lengths))


def years(quick: bool) -> bool:
    """Years of 365 nights with 8 equally strong candidates, and one that is stronger on night 300."""
    alpha = alpha_per_verdict(CANDIDATES, 0.05)
    settings = SINGLE.of_one_verdict(alpha)
    null, better = (np.asarray(p)[[0, 2, 4]] for p in (EQUALS["decisive"], stronger(EQUALS["decisive"], 60)))
    ends = boundary(settings, [null, better])
    each = chance(ends, null)
    exact = 1 - (1 - each) ** (NIGHTS * CANDIDATES)
    print(f"  alpha of a verdict {alpha:.3g}; chance of its false promotion {each:.3g}, of any in a year {exact:.2%}")
    number, rng = 100 if quick else 1_000, np.random.default_rng(3)
    false = [int(walk(settings, ends, null, NIGHTS * CANDIDATES, rng)[0].sum()) for _ in range(number)]
    with_any = sum(count > 0 for count in false)
    low, high = binomtest(with_any, number).proportion_ci(0.95)
    print(
        f"  {number} simulated years, {sum(false)} of {number * NIGHTS * CANDIDATES} verdicts false: any in"
        f" {with_any / number:.2%} [{low:.2%}, {high:.2%}] of years (≤ 5 %)"
    )
    promoted, blocks = walk(settings, ends, better, 20_000, rng)
    anchor = settings.against_anchor(50.0)
    anchored = boundary(anchor, [better])
    passed = [walk(anchor, anchored, better, 20_000, rng) for _ in range(2)]
    both = promoted & passed[0][0] & passed[1][0]
    games = 2 * (blocks + passed[0][1] + passed[1][1])
    print(
        f"  night 300, +{settings.elo1:g}: beats the champion {promoted.mean():.2%}, and is not inferior to two earlier"
        f" champions as strong as that one {both.mean():.2%} (≥ 90 %), in {games.mean():.0f} games on average, 95 %"
        f" within {np.quantile(games, 0.95):.0f} (at most {2 * settings.max_blocks} a test)"
    )
    return exact <= 0.05 and bool(both.mean() >= 0.9)


def traps(quick: bool) -> bool:
    """Challengers that beat the champion by 100 Elo and lose to an anchor by 100 Elo more than the margin."""
    number, margin, rng = 100 if quick else 1_000, 50.0, np.random.default_rng(4)
    settings = GateConfig(elo0=0, elo1=30, max_blocks=4000, margin=margin).of_one_verdict(alpha_per_verdict(1, 0.05))
    against_champion = stronger(EQUALS["decisive"], 100)
    against_anchor = stronger(EQUALS["decisive"], -margin - 100)
    beaten = promoted = 0
    for _ in range(number):
        champion = _decided(settings, against_champion, rng)
        anchor = _decided(settings.against_anchor(settings.margin), against_anchor, rng)
        seen = combine_results(
            champion, [AnchorResult(AnchorTest("trap@1", margin, "s"), anchor)], planned_companions=1, forfeits=0
        )
        beaten += champion.outcome == "promote"
        promoted += seen.outcome == "promote"
    print(f"  {number} traps: {beaten} beat the champion, {promoted} promoted (0)")
    return promoted == 0 and beaten > 0.95 * number


def _decided(settings: GateConfig, shares: np.ndarray, rng: np.random.Generator) -> Decision:
    scores: list[float] = []
    while (decision := decide(settings, scores)).outcome is None:
        scores += CELLS[rng.choice(5, p=shares, size=200)].tolist()
    return decision


def play(quick: bool) -> bool:
    """Gates with real games between equally strong versions."""
    number, met = 20 if quick else 200, True
    for same, description in (
        (True, "one policy under two numbers"),
        (False, "one policy, and the same on a turned board"),
    ):
        with tempfile.TemporaryDirectory() as home:
            registry = tictactoe.registry(Path(home), play={"opening_plies": 2, "num_envs": 100})
            promoted = null_play.promoted(registry, same, number)
            registry.close()
        low, high = binomtest(promoted, number).proportion_ci(0.95)
        print(
            f"  {number} gates, {description}: {promoted} promoted, "
            f"{promoted / number:.1%} [{low:.1%}, {high:.1%}] (≤ 5 %)"
        )
        met &= low <= 0.05
    return met


def sampled(quick: bool) -> bool:
    """Gates of sampled games: simulated with their exact probabilities, and played."""
    shares = sampled_play.shares(sampled_play.policy())
    met = _simulated(f"Kuhn poker, {1 - shares[2]:.1%} of blocks uneven", shares, quick)
    number = 20 if quick else 200
    promoted, uneven = sampled_play.promoted(number)
    low, high = binomtest(promoted, number).proportion_ci(0.95)
    print(
        f"  {number} gates, one policy under two numbers, {uneven:.1%} of blocks uneven: {promoted} promoted, "
        f"{promoted / number:.1%} [{low:.1%}, {high:.1%}] (≤ 5 %)"
    )
    return met and bool(low <= 0.05)


def exploiters(quick: bool) -> bool:
    """Tests against exploiters at the default margin, and intervals of the difference in exploitability."""
    number, margin, met = 200 if quick else 1_000, SINGLE.margin_against_exploiters, True
    settings = SINGLE.model_copy(update={"max_blocks": 4000}).compared_with_champion(margin)
    for pairs in (1, 3):
        found = {gap: exploiter_gates.simulated(settings, gap, pairs, number) for gap in (0.0, -margin)}
        wrong = {0.0: ~found[0.0].promoted, -margin: found[-margin].promoted}
        shares = {gap: float(each.mean()) for gap, each in wrong.items()}
        lows = {gap: binomtest(int(each.sum()), number).proportion_ci(0.95).low for gap, each in wrong.items()}
        blocks = {gap: float(each.blocks.mean()) for gap, each in found.items()}
        print(
            f"  {pairs} exploiter(s) of each, {number} gates: as exploitable: {shares[0.0]:.2%} refused (≤ 5 %) after"
            f" {blocks[0.0]:.0f} rounds on average; more by {margin:g}: {shares[-margin]:.2%} passed (≤ 5 %) after"
            f" {blocks[-margin]:.0f}"
        )
        met &= max(lows.values()) <= 0.05
    for spread in (0.0, 0.03, 0.1):
        rates = {
            gap: float(exploiter_gates.simulated(settings, gap, 3, number, spread).promoted.mean())
            for gap in (0.0, -margin)
        }
        by_block, by_both = exploiter_gates.coverage(number, spread)
        print(
            f"  3 exploiters with a standard deviation of {spread:g} between trainings: as exploitable on average:"
            f" {1 - rates[0.0]:.2%} refused; more by {margin:g}: {rates[-margin]:.2%} passed; 95 % interval over"
            f" blocks covers {by_block:.2%}, over blocks and exploiters {by_both:.2%} (95 %)"
        )
        met &= _high(round(by_both * number), number) >= 0.95
    return met


AGAINST_ANCHORS = {
    "as strong as the champion": (0.5, 0.0),
    "stronger: the champion scores 22 %": (0.22, 0.0),
    "weaker, and four of five games of candidate and champion are the same": (0.7, 0.8),
}
"""Anchor → mean score of the champion against it, and the share of equal games."""


def anchors(quick: bool) -> bool:
    """Tests that a candidate does no worse than the champion against an anchor, at the default margin."""
    margin, met = SINGLE.margin_against_exploiters, True
    for alpha, number in ((0.05, 500 if quick else 5_000), (alpha_per_verdict(1, 0.05), 500 if quick else 20_000)):
        settings = GateConfig().of_one_verdict(alpha).compared_with_champion(margin)
        for anchor, (champion, alike) in AGAINST_ANCHORS.items():
            worse, equal, better = (
                exploiter_gates.against_anchor(settings, champion, gap, alike, number, seed)
                for seed, gap in enumerate((-margin, 0.0, margin / 2), start=21)
            )
            false, passed = int(worse.promoted.sum()), int(equal.promoted.sum())
            ends = binomtest(false, number).proportion_ci(0.95)
            print(
                f"  α = {alpha:.2g}, anchor {anchor}, {number} tests: worse by {margin:g}: {false / number:.3%} passed"
                f" [{ends.low:.3%}, {ends.high:.3%}] (≤ {alpha:.3%}); as good: {passed / number:.2%} passed (≥ 95 %)"
                f" after {equal.blocks.mean():.0f} pairs on average; better by {margin / 2:g}:"
                f" {better.promoted.mean():.2%} after {better.blocks.mean():.0f}"
            )
            met &= ends.low <= alpha and _high(passed, number) >= 0.95
    return met


def order(quick: bool) -> bool:
    """Games whose duration depends on their result, on workers that finish them in any order."""
    number = 100 if quick else 1_000
    found = verdicts_of_shuffled_completion(number)
    print(f"  {number} orders of completion, durations by outcome: {len(found)} different verdict(s) (1): {found}")
    return len(found) == 1


def intervals(quick: bool) -> bool:
    """Nominal 95 % intervals with a fixed number of blocks."""
    number, met = 500 if quick else 5_000, True
    parts: dict[str, Callable[[int, int], float]] = {
        "Elo, 200 blocks": coverage.elo,
        "Bradley–Terry ratings, 200 blocks a pair": coverage.rating,
        "IQM, 40 runs on 5 tasks": coverage.interquartile_mean,
        "probability of improvement, 40 runs on 5 tasks": coverage.improvement,
    }
    for words, part in parts.items():
        share = part(number, 5)
        error = math.sqrt(share * (1 - share) / number)
        print(f"  {words}: {share:.2%} ± {error:.2%} of {number} simulations covered (94 to 96 %)")
        met &= 0.94 <= share <= 0.96
    return met


PARTS: dict[str, Callable[[bool], bool]] = {
    "golden": lambda _: golden.run(),
    "gates": gates,
    "years": years,
    "traps": traps,
    "order": order,
    "play": play,
    "sampled": sampled,
    "exploiters": exploiters,
    "anchors": anchors,
    "intervals": intervals,
}


def main() -> int:
    """Print each part; 1 if a target was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a twentieth of the simulations")
    parser.add_argument("--only", choices=PARTS, help="one part")
    options = parser.parse_args()
    missed = []
    for name in [options.only] if options.only else PARTS:
        print(f"{name}:", flush=True)
        began = time.monotonic()
        if not PARTS[name](options.quick):
            missed.append(name)
        print(f"  ({time.monotonic() - began:.0f} s)", flush=True)
    print(f"missed: {', '.join(missed) or 'nothing'}")
    return bool(missed)


def _high(found: int, number: int) -> float:
    return float(binomtest(found, number).proportion_ci(0.95).high)


if __name__ == "__main__":
    sys.exit(main())
