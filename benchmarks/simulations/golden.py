"""Published numbers beside ours: fastchess, fishtest, OpenSpiel, evalica, rliable, confseq."""

from __future__ import annotations

import numpy as np

from evaluation.statistics.bradley_terry import bradley_terry
from evaluation.statistics.improvement import iqm, probability_of_improvement
from evaluation.statistics.sequential import bernoulli_interval, bounds, elo_estimate, expected_games, gsprt_llr
from league.results.equilibria import alpha_rank, nash_averaging

CYCLE = np.array([[0.5, 0.0, 1.0], [1.0, 0.5, 0.0], [0.0, 1.0, 0.5]])
TRANSITIVE = np.array([[0.0, -1.0, -1.0], [1.0, 0.0, -1.0], [1.0, 1.0, 0.0]])
FOOD = {
    (0, 1): (1, 2), (0, 2): (1, 2), (0, 3): (4, 5), (0, 4): (4, 4), (1, 2): (4, 6),
    (1, 3): (1.5, 2), (1, 4): (0, 2), (2, 3): (0, 2), (2, 4): (3, 3), (3, 4): (0.5, 2),
}  # fmt: skip
"""evalica's food.csv: score of the first contestant and games of each pair."""
Row = tuple[str, float, float, float]


def _sequential() -> list[Row]:
    pair = (13, 37, 50, 25, 3)
    drawn = (96, 111, 136)
    of_pair, logistic, normalized = (
        elo_estimate(pair, "normalized"),
        elo_estimate(drawn, "logistic"),
        elo_estimate(drawn, "normalized"),
    )
    return [
        ("fastchess, LLR of (36433, 36027, 68692), normalized 0, 2", 0.92, _llr((36027, 68692, 36433), 0, 2), 5e-3),
        ("fastchess, LLR of pairs, normalized 0, 2", 2.25, _llr((365, 16618, 36229, 16974, 390), 0, 2), 5e-3),
        ("fishtest, LLR of (13, 37, 50, 25, 3), normalized 0, 4", -0.54912, _llr(pair, 0, 4), 1e-5),
        ("its normalized Elo", -63.97, of_pair.elo, 5e-3),
        ("fastchess, Elo of W136 L96 D111", 40.70, logistic.elo, 6e-3),
        ("its interval, ±", 30.43, (logistic.high - logistic.low) / 2, 6e-3),
        ("its normalized Elo", 49.77, normalized.elo, 6e-3),
        ("its interval, ±", 36.77, (normalized.high - normalized.low) / 2, 6e-3),
        ("SPRT bound at 0.05, 0.05", 2.9444, bounds(0.05, 0.05)[1], 5e-5),
        ("games of [0, 35] at H1", 522, expected_games(0, 35, 35, 0.05, 0.05), 0.5),
        ("games of [0, 35] halfway", 854, expected_games(0, 35, 17.5, 0.05, 0.05), 0.5),
        ("games of [0, 20] at H1", 1599, expected_games(0, 20, 20, 0.05, 0.05), 0.5),
        ("games of [0, 20] halfway", 2616, expected_games(0, 20, 10, 0.05, 0.05), 0.5),
        ("confseq, 700 of 1,000, low", 0.651629, bernoulli_interval(700, 1000, 0.05, 100)[0], 1e-6),
        ("confseq, 700 of 1,000, high", 0.745949, bernoulli_interval(700, 1000, 0.05, 100)[1], 1e-6),
    ]


def _llr(counts: tuple[int, ...], elo0: float, elo1: float) -> float:
    return float(gsprt_llr(counts, elo0, elo1, "normalized"))


def _tables() -> list[Row]:
    food = _strengths(FOOD, 5)
    openspiel = _strengths({(0, 1): (4, 5), (0, 2): (2, 5), (1, 2): (2, 5)}, 3)
    cycle, ladder = nash_averaging(2 * CYCLE - 1), nash_averaging(TRANSITIVE)
    names = ("Tacos", "Sushi", "Burger", "Pasta", "Pizza")
    return [
        *(
            (f"evalica, {name}", wanted, float(ours), 2e-6)
            for name, wanted, ours in zip(names, (0.434290, 0.190600, 0.147977, 0.128153, 0.098980), food, strict=True)
        ),
        ("OpenSpiel, A = C: their difference", 0.0, float(openspiel[0] - openspiel[2]), 1e-9),
        ("OpenSpiel, α-Rank of rock, paper, scissors: least", 1 / 3, float(alpha_rank(CYCLE).min()), 1e-4),
        ("Nash averaging of it: least share", 1 / 3, float(cycle[0].min()), 1e-4),
        ("its greatest payoff", 0.0, float(cycle[1].max()), 1e-4),
        ("Nash averaging of a ladder: share of the best", 1.0, float(ladder[0][2]), 1e-4),
        ("its payoffs: the second", -1.0, float(ladder[1][1]), 1e-4),
        ("rliable, IQM", 1.5, iqm([[1, 2], [2, 2], [1, 1], [2, 1]]), 1e-9),
        (
            "rliable, probability of improvement",
            1 / 3,
            probability_of_improvement([[1, 2], [2, 2], [1, 1], [2, 1]], [[1, 1], [2, 2], [3, 3]]),
            1e-9,
        ),
    ]


def _strengths(games: dict[tuple[int, int], tuple[float, float]], size: int) -> np.ndarray:
    points, played = np.array(list(games.values()), dtype=float).T
    strengths = np.exp(bradley_terry(points[None], played[None], np.array(list(games)), size, anchor=0)[0])
    return np.asarray(strengths / strengths.sum())


def run() -> bool:
    """Print each number beside ours; returns whether all agree."""
    met = True
    for name, theirs, ours, tolerance in [*_sequential(), *_tables()]:
        agrees = abs(ours - theirs) <= tolerance
        met &= agrees
        print(f"  {name}: {theirs:g}, ours {ours:.6g} (within {tolerance:g}){'' if agrees else ': MISSED'}")
    return met
