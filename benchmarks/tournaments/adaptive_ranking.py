"""Does the adaptive schedule, with a quarter of the games, rank as well as a full round robin?

Simulation: 64 contestants in steps of 25 Elo; each game is drawn from the logistic model. The round robin plays
some matches of two games between each pair (32 is the default of `league evaluate`), the adaptive schedule a
quarter of that in total. Both are rated like the league, and Kendall's τ of the ratings and the true strengths is
compared for each seed. A second ladder has uneven steps: 25 Elo on average, exponentially distributed.

Target: the round robin's τ, less at most 0.005, at the default number of matches; results for fewer are printed.
"""

import math
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from scipy.stats import kendalltau

from benchmarks.harness import Target
from evaluation.schedules.adaptive_pairing import choose, ring, round_size
from evaluation.schedules.tournament_plan import ADAPTIVE_SHARE, DEFAULT_BLOCKS
from evaluation.statistics.bradley_terry import posterior
from league.results.records import GAMES_PER_BLOCK

CONTESTANTS = 64
STEP = 25 * math.log(10) / 400
"""25 Elo in log odds."""
Floats = NDArray[np.float64]


def run(quick: bool) -> Iterator[Target]:
    """Simulate tournaments with each number of matches on both ladders."""
    seeds = 10 if quick else 200
    for ladder in LADDERS:
        for matches in [DEFAULT_BLOCKS] if quick else [4, 10, DEFAULT_BLOCKS]:
            yield compare(ladder, matches, seeds)


def compare(ladder: str, matches: int, seeds: int) -> Target:
    """Compare both schedules. matches: of each pair in the round robin."""
    budget = matches * CONTESTANTS * (CONTESTANTS - 1) // 2 // ADAPTIVE_SHARE
    taus, slowest = np.zeros((seeds, 2)), 0.0
    for seed in range(seeds):
        truth = LADDERS[ladder](np.random.default_rng([seed, 0]))
        taus[seed, 0] = _tau(_round_robin(truth, matches, np.random.default_rng([seed, 1])), truth)
        played, seconds = _adaptive(truth, budget, np.random.default_rng([seed, 2]))
        taus[seed, 1] = _tau(played, truth)
        slowest = max(slowest, seconds)
    gains = taus[:, 1] - taus[:, 0]
    error = 1.96 * gains.std(ddof=1) / math.sqrt(seeds)
    note = f"± {error:.4f}; slowest round {slowest:.3f} s"
    name = f"adaptive, {ladder} ladder, {matches} matches a pair: change of τ"
    least = -0.005 if matches == DEFAULT_BLOCKS else None
    return Target(name, round(float(gains.mean()), 4), at_least=least, peer="round robin", note=note)


def _even(rng: np.random.Generator) -> Floats:  # noqa: ARG001
    return STEP * np.arange(CONTESTANTS)


def _uneven(rng: np.random.Generator) -> Floats:
    return STEP * np.cumsum(rng.standard_exponential(CONTESTANTS))


LADDERS = {"even": _even, "uneven": _uneven}

Table = tuple[Floats, Floats]
"""points[i, j]: score of i against j; games[i, j]"""


def _round_robin(truth: Floats, matches: int, rng: np.random.Generator) -> Table:
    first, second = np.triu_indices(CONTESTANTS, 1)
    points, games = np.zeros((2, CONTESTANTS, CONTESTANTS))
    number = matches * GAMES_PER_BLOCK
    won = rng.binomial(number, expit(truth[first] - truth[second]))
    points[first, second], points[second, first] = won, number - won
    games[first, second] = games[second, first] = number
    return points, games


def _adaptive(truth: Floats, matches: int, rng: np.random.Generator) -> tuple[Table, float]:
    """The played games, and the duration of the slowest choice of a round in seconds."""
    points, games = np.zeros((2, CONTESTANTS, CONTESTANTS))
    played, slowest = 0, 0.0
    while played < matches:
        began = time.perf_counter()
        size = min(round_size(CONTESTANTS, played), matches - played)
        pairings = choose(points, games, size) if played else ring(CONTESTANTS, int(rng.integers(2**32)))
        slowest = max(slowest, time.perf_counter() - began)
        for i, j in pairings[:size]:
            won = rng.binomial(GAMES_PER_BLOCK, expit(truth[i] - truth[j]))
            points[[i, j], [j, i]] += won, GAMES_PER_BLOCK - won
            games[[i, j], [j, i]] += GAMES_PER_BLOCK
        played += size
    return (points, games), slowest


def _tau(table: Table, truth: Floats) -> float:
    """Kendall's τ of the league's ratings."""
    return float(kendalltau(posterior(*table)[0], truth).statistic)
