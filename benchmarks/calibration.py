"""Do verdicts have their nominal error rates?

Simulations of gates, years, anchors, intervals and ratings, and gates with real games.

Each part prints measured values beside their targets. All parts are seeded, so that the numbers are reproducible on any
machine.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.stats import binom, binomtest

from benchmarks.harness import Parts, Quick, Target, chosen
from benchmarks.simulations import coverage, exploiter_gates, ladders, null_play, sampled_play
from benchmarks.simulations.shuffled_order import verdicts_of_shuffled_completion
from benchmarks.simulations.simulated_gates import CELLS, EQUALS, simulate, stronger
from benchmarks.simulations.simulated_years import boundary, chance, walk
from evaluation.gating.gate import Decision, decide
from evaluation.gating.gate_result import GateResult
from evaluation.statistics.alpha_spending import NIGHTS, alpha_per_verdict
from evaluation.statistics.sequential import expected_games
from league.config.gate import GateConfig
from tests.support.gate_results import decided
from tests.support.leagues import tictactoe

CANDIDATES = 8
SINGLE = GateConfig(elo0=0, elo1=60, max_blocks=1000, nights=None)


def gates(quick: bool) -> Iterator[Target]:
    """20,000 gates for each hypothesis and three kinds of games."""
    for kind, shares in EQUALS.items():
        yield from _simulated(kind, shares, 1_000 if quick else 20_000)


def _simulated(kind: str, shares: tuple[float, ...], number: int) -> Iterator[Target]:
    """Gates of games with these shares of the cells between equal players."""
    theory = expected_games(SINGLE.elo0, SINGLE.elo1, SINGLE.elo0, SINGLE.alpha, SINGLE.beta)
    null = simulate(SINGLE, np.asarray(shares), number, seed=1)
    better = simulate(SINGLE, stronger(shares, SINGLE.elo1), number, seed=2)
    yield _upper(f"{kind}: promoted at H0", int(null.promoted.sum()), number, 5.3)
    yield Target(f"{kind}: promoted at H1", _percent(better.promoted.mean()), "%", at_least=95.0)
    lengths = tuple(round(2 * float(gates.blocks.mean()) / theory, 3) for gates in (null, better))
    yield Target(f"{kind}: length at H0 and H1", lengths, "×", at_least=0.9, at_most=1.1, peer="theory")


def years(quick: bool) -> Iterator[Target]:
    """Years of 365 nights with 8 equally strong candidates, and one that is stronger on night 300."""
    settings = SINGLE.of_one_verdict(alpha_per_verdict(CANDIDATES, 0.05))
    null, better = (np.asarray(p)[[0, 2, 4]] for p in (EQUALS["decisive"], stronger(EQUALS["decisive"], 60)))
    ends = boundary(settings, [null, better])
    exact = 1 - (1 - chance(ends, null)) ** (NIGHTS * CANDIDATES)
    yield Target("years with a false promotion, exact", _percent(exact), "%", at_most=5.0)
    number, rng = 100 if quick else 1_000, np.random.default_rng(3)
    false = [int(walk(settings, ends, null, NIGHTS * CANDIDATES, rng)[0].sum()) for _ in range(number)]
    note = f"{sum(false)} of {number * NIGHTS * CANDIDATES:,} verdicts"
    yield Target("years with a false promotion, simulated", _percent(np.mean([*map(bool, false)])), "%", note=note)
    promoted, blocks = walk(settings, ends, better, 20_000, rng)
    anchor = settings.against_anchor(50.0)
    anchored = boundary(anchor, [better])
    passed = [walk(anchor, anchored, better, 20_000, rng) for _ in range(2)]
    both = promoted & passed[0][0] & passed[1][0]
    games = 2 * (blocks + passed[0][1] + passed[1][1])
    note = f"{games.mean():.0f} games on average, 95 % within {np.quantile(games, 0.95):.0f}"
    yield Target("better candidate of night 300 promoted", _percent(both.mean()), "%", at_least=90.0, note=note)


def traps(quick: bool) -> Iterator[Target]:
    """Challengers that beat the champion by 100 Elo and lose to an anchor by 100 Elo more than the margin."""
    number, margin, rng = 100 if quick else 1_000, 50.0, np.random.default_rng(4)
    settings = GateConfig(elo0=0, elo1=30, max_blocks=4000, margin=margin).of_one_verdict(alpha_per_verdict(1, 0.05))
    against_champion = stronger(EQUALS["decisive"], 100)
    against_anchor = stronger(EQUALS["decisive"], -margin - 100)
    beaten = promoted = 0
    for _ in range(number):
        champion = _decided(settings, against_champion, rng)
        anchor = _decided(settings.against_anchor(settings.margin), against_anchor, rng)
        result = GateResult(settings, decided(champion), (decided(anchor),), planned=1, forfeits=0)
        beaten += champion.outcome == "promote"
        promoted += result.outcome == "promote"
    yield Target("non-transitive candidates promoted", promoted, f"of {number}", at_most=0)
    yield Target("non-transitive candidates that beat the champion", beaten, f"of {number}", at_least=0.95 * number)


def _decided(settings: GateConfig, shares: np.ndarray, rng: np.random.Generator) -> Decision:
    scores: list[float] = []
    while (decision := decide(settings, scores)).outcome is None:
        scores += CELLS[rng.choice(5, p=shares, size=200)].tolist()
    return decision


def play(quick: bool) -> Iterator[Target]:
    """Gates with real games between equally strong versions."""
    number = 20 if quick else 200
    for same, kind in ((True, "one policy under two numbers"), (False, "one policy on a turned board")):
        with tempfile.TemporaryDirectory() as home:
            registry = tictactoe.registry(Path(home), play={"opening_plies": 2, "num_envs": 100})
            promoted = null_play.promoted(registry, same, number)
            registry.close()
        yield _lower(f"real games, {kind}: promoted", promoted, number)


def sampled(quick: bool) -> Iterator[Target]:
    """Gates of sampled games: simulated with their exact probabilities, and played."""
    yield from _simulated("sampled Kuhn poker", sampled_play.shares(sampled_play.policy()), 1_000 if quick else 20_000)
    number = 20 if quick else 200
    promoted, _ = sampled_play.promoted(number)
    yield _lower("real games, sampled Kuhn poker: promoted", promoted, number)


def exploiters(quick: bool) -> Iterator[Target]:
    """Tests against exploiters at the default margin, and intervals of the difference in exploitability."""
    number, margin = 200 if quick else 1_000, SINGLE.margin_against_exploiters
    settings = SINGLE.model_copy(update={"max_blocks": 4000}).compared_with_champion(margin)
    for pairs in (1, 3):
        equal, worse = (exploiter_gates.simulated(settings, gap, pairs, number) for gap in (0.0, -margin))
        yield _lower(f"exploiters, {pairs}: equal refused", int((~equal.promoted).sum()), number)
        yield _lower(f"exploiters, {pairs}: worse passed", int(worse.promoted.sum()), number)
    for spread in (0.0, 0.03, 0.1):
        equal, worse = (exploiter_gates.simulated(settings, gap, 3, number, spread) for gap in (0.0, -margin))
        wrong = (_percent(1 - equal.promoted.mean()), _percent(worse.promoted.mean()))
        yield Target(f"exploiters, deviation {spread:g}: equal refused, worse passed", wrong, "%")
        by_block, by_both = exploiter_gates.coverage(number, spread)
        yield Target(f"exploiters, deviation {spread:g}: coverage over rounds", _percent(by_block), "%")
        name = f"exploiters, deviation {spread:g}: coverage over rounds and exploiters"
        least = 100 * binom.ppf(0.025, number, 0.95) / number
        yield Target(name, _percent(by_both), "%", at_least=round(float(least), 2))


AGAINST_ANCHORS = {"equal": (0.5, 0.0), "stronger": (0.22, 0.0), "weaker": (0.7, 0.8)}
"""Strength of an anchor → mean score of the champion against it, and the share of equal games."""


def anchors(quick: bool) -> Iterator[Target]:
    """Tests that a candidate does no worse than the champion against an anchor, at the default margin."""
    margin = SINGLE.margin_against_exploiters
    for alpha, number in ((0.05, 500 if quick else 5_000), (alpha_per_verdict(1, 0.05), 500 if quick else 20_000)):
        settings = GateConfig().of_one_verdict(alpha).compared_with_champion(margin)
        for anchor, (champion, alike) in AGAINST_ANCHORS.items():
            worse, equal, better = (
                exploiter_gates.against_anchor(settings, champion, gap, alike, number, seed)
                for seed, gap in enumerate((-margin, 0.0, margin / 2), start=21)
            )
            name = f"anchor, α {alpha:.2g}, {anchor}"
            yield _lower(f"{name}: worse passed", int(worse.promoted.sum()), number, alpha)
            passed = _percent(equal.promoted.mean())
            pairs = f"{equal.blocks.mean():.0f} pairs"
            note = f"{pairs}; better {better.promoted.mean():.2%}, {better.blocks.mean():.0f} pairs"
            least = 100 * binom.ppf(0.025, number, 0.95) / number
            yield Target(f"{name}: as good passed", passed, "%", at_least=round(float(least), 2), note=note)


def order(quick: bool) -> Iterator[Target]:
    """Games whose duration depends on their result, on workers that finish them in any order."""
    number = 100 if quick else 1_000
    verdicts = verdicts_of_shuffled_completion(number)
    yield Target("verdicts of shuffled orders of completion", len(verdicts), at_most=1, note=f"{number} orders")


def intervals(quick: bool) -> Iterator[Target]:
    """Every other interval that is printed: ordinary, small and lopsided samples."""
    yield from coverage.run(100 if quick else 2_000)


def ratings(quick: bool) -> Iterator[Target]:
    """Ratings of ladders: bias of the best, and coverage of nominal 95 % intervals."""
    yield from ladders.run(20, 4) if quick else ladders.run(200, 40)


PARTS: dict[str, Callable[[bool], Iterator[Target]]] = {
    "gates": gates,
    "years": years,
    "traps": traps,
    "order": order,
    "play": play,
    "sampled": sampled,
    "exploiters": exploiters,
    "anchors": anchors,
    "intervals": intervals,
    "ratings": ratings,
}


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Simulate the parts; a twentieth of the simulations is enough for a smoke test."""
    for part in chosen(parts, PARTS).values():
        yield from part(quick)


def _percent(share: float) -> float:
    return round(100 * float(share), 3)


def _upper(name: str, count: int, number: int, most: float) -> Target:
    """A share whose upper 95 % bound must not exceed a number of percent."""
    high = _percent(binomtest(count, number).proportion_ci(0.95).high)
    return Target(f"{name}, upper bound", high, "%", at_most=most, note=f"{count / number:.2%}")


def _lower(name: str, count: int, number: int, rate: float = 0.05) -> Target:
    """A share that must not be significantly above a rate."""
    most = int(binom.ppf(0.975, number, rate))
    return Target(name, count, f"of {number:,}", at_most=most, note=f"{count / number:.3%}")
