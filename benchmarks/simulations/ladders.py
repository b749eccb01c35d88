"""Are ratings of wide ladders right? Bias of the best contestant, and how often intervals hold the true ratings.

Blocks are two games with swapped sides, whose results are drawn from the logistic model, with an advantage of the first
side and a share of draws. Contestant 0 is the anchor.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Target
from evaluation.schedules.adaptive_pairing import choose, ring, round_size
from evaluation.schedules.tournament_plan import ADAPTIVE_SHARE
from evaluation.statistics.bradley_terry import rate
from league.results.records import GAMES_PER_BLOCK, Outcome

Floats = NDArray[np.float64]
Pair = tuple[int, int]
POINTS = np.add.outer([1.0, 0.5, 0.0], [1.0, 0.5, 0.0]).reshape(-1)
"""Points of the first contestant in the nine results of a block."""


@dataclass(frozen=True, slots=True)
class Ladder:
    """A case.

    name: of the case. elos: true ratings. blocks: of each pair. schedule: who meets whom. advantage: of the first side
    in Elo. draws: share of drawn games between equals.
    """

    name: str
    elos: Floats
    blocks: int
    schedule: str = "round robin"
    advantage: float = 0.0
    draws: float = 0.0


def _ladders() -> Iterator[Ladder]:
    for advantage, draws in ((0.0, 0.0), (50.0, 0.3)):
        sides = {"advantage": advantage, "draws": draws}
        for size, blocks, spread in (
            (3, 32, 90),
            (3, 8, 400),
            (8, 32, 1200),
            (8, 8, 1200),
            (20, 16, 1500),
            (20, 8, 1500),
        ):
            yield Ladder(f"{size} over {spread} Elo, {blocks} blocks", np.linspace(0, spread, size), blocks, **sides)
        steps = np.linspace(0, 1500, 60)
        shapes = {
            "60 over 1500 Elo": steps,
            "60, one undefeated, one winless": np.concatenate([[0, -800], steps[2:-1], [2300]]),
            "60, of which 59 far above the anchor": np.concatenate([[0], np.linspace(900, 1500, 59)]),
        }
        for name, elos in shapes.items():
            for schedule in ("round robin", "gauntlets", "adaptive"):
                yield Ladder(f"{name}, 16 blocks, {schedule}", elos, 16, schedule, **sides)


def run(draws: int, adaptive_draws: int) -> Iterator[Target]:
    """Simulate all ladders."""
    for ladder in _ladders():
        number = adaptive_draws if ladder.schedule == "adaptive" else draws
        names = [f"{i:02}" for i in range(len(ladder.elos))]
        errors, covered = np.zeros(number), np.zeros(number)
        for draw in range(number):
            ratings = rate(_results(ladder, names, np.random.default_rng(draw)), names[0])
            rated = np.array([(rating.elo, rating.low, rating.high) for rating in ratings.values()], dtype=float)
            errors[draw] = rated[-1, 0] - ladder.elos[-1]
            covered[draw] = ((rated[1:, 1] <= ladder.elos[1:]) & (ladder.elos[1:] <= rated[1:, 2])).mean()
        name = f"{ladder.name}{', first side +50 Elo' if ladder.advantage else ''}"
        most = 40.0 if ladder.advantage else 20.0
        note = f"± {1.96 * errors.std() / number**0.5:.0f} Elo"
        yield Target(
            f"{name}: best is off by", round(float(errors.mean())), "Elo", at_most=most, at_least=-most, note=note
        )
        least = 90.0 if ladder.advantage or ladder.blocks == 8 else 92.0
        note = f"± {196 * covered.std() / number**0.5:.1f} %"
        yield Target(f"{name}: coverage", round(100 * float(covered.mean()), 1), "%", at_least=least, note=note)


def _results(ladder: Ladder, names: list[str], rng: np.random.Generator) -> list[Outcome]:
    if ladder.schedule == "adaptive":
        played = _adaptive(ladder, rng)
    else:
        pairs = _pairs(ladder)
        numbers = rng.multinomial(ladder.blocks, _shares(ladder, pairs))
        played = Counter[tuple[Pair, float]]()
        for pair, row in zip(pairs, numbers.tolist(), strict=True):
            for points, number in zip(POINTS.tolist(), row, strict=True):
                played[pair, points] += number
    return [
        Outcome((names[i], names[j]), GAMES_PER_BLOCK, (points, GAMES_PER_BLOCK - points), number)
        for ((i, j), points), number in played.items()
        if number
    ]


def _pairs(ladder: Ladder) -> list[Pair]:
    """All pairs; in gauntlets, each version meets the three before it, and the anchor."""
    pairs = list(combinations(range(len(ladder.elos)), 2))
    return pairs if ladder.schedule == "round robin" else [(i, j) for i, j in pairs if j - i <= 3 or i == 0]


def _shares(ladder: Ladder, pairs: list[Pair]) -> Floats:
    """Probabilities (p, 9) of the results of a block."""
    gap = np.array([ladder.elos[i] - ladder.elos[j] for i, j in pairs])
    games = []
    for advantage in (ladder.advantage, -ladder.advantage):
        score = 1 / (1 + 10 ** (-(gap + advantage) / 400))
        drawn = 2 * ladder.draws * np.minimum(score, 1 - score)
        games.append(np.stack([score - drawn / 2, drawn, 1 - score - drawn / 2], axis=1))
    return np.asarray((games[0][:, :, None] * games[1][:, None, :]).reshape(-1, 9))


def _adaptive(ladder: Ladder, rng: np.random.Generator) -> Counter[tuple[Pair, float]]:
    """An adaptive tournament with a quarter of the matches of the round robin, as by default."""
    size = len(ladder.elos)
    played, number = Counter[tuple[Pair, float]](), 0
    points, games = np.zeros((2, size, size))
    while (left := ladder.blocks * size * (size - 1) // 2 // ADAPTIVE_SHARE - number) > 0:
        pairs = (
            choose(points, games, min(left, round_size(size, number))) if number else ring(size, int(rng.integers(99)))
        )
        for pair, shares in zip(pairs, _shares(ladder, pairs), strict=True):
            scored = float(rng.choice(POINTS, p=shares))
            played[pair, scored] += 1
            i, j = pair
            points[[i, j], [j, i]] += scored, GAMES_PER_BLOCK - scored
            games[[i, j], [j, i]] += GAMES_PER_BLOCK
        number += len(pairs)
    return played
