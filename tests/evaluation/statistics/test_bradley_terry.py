import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.statistics.bradley_terry import ELO, Rating, bradley_terry, rate
from evaluation.statistics.sequential import score_of
from league.results.records import Outcome
from tests.support.closeness import close

RANDOM = "script:random"

# Wins, with ties as halves, of evalica's food.csv: pair → score of the first, games.
FOOD = ("Tacos", "Sushi", "Burger", "Pasta", "Pizza")
FOOD_GAMES = {
    (0, 1): (1, 2),
    (0, 2): (1, 2),
    (0, 3): (4, 5),
    (0, 4): (4, 4),
    (1, 2): (4, 6),
    (1, 3): (1.5, 2),
    (1, 4): (0, 2),
    (2, 3): (0, 2),
    (2, 4): (3, 3),
    (3, 4): (0.5, 2),
}
FOOD_STRENGTHS = (0.434290, 0.190600, 0.147977, 0.128153, 0.098980)


def block(first: str, second: str, score: float, games: int = 2) -> Outcome:
    """A block with this mean score of the first contestant."""
    points = (score * games, (1 - score) * games)
    return Outcome((first, second), games, points)


def fitted(games: dict[tuple[int, int], tuple[float, float]], size: int) -> np.ndarray:
    pairs = np.array(list(games))
    points, played = np.array(list(games.values()), dtype=float).T
    return bradley_terry(points[None], played[None], pairs, size, anchor=0)[0]


def simulated(
    elos: Sequence[float], blocks: int, rng: np.random.Generator, names: Sequence[str] | None = None
) -> list[Outcome]:
    """Blocks of a round robin between contestants of known strength; contestant 0 is `script:random`."""
    names = names or [RANDOM, *(f"league@{i}" for i in range(1, len(elos)))]
    return [
        block(names[i], names[j], float(score))
        for i in range(len(elos))
        for j in range(i)
        for score in rng.binomial(2, score_of(elos[i] - elos[j]), blocks) / 2
    ]


def test_strengths_equal_those_of_evalica() -> None:
    strengths = np.exp(fitted(FOOD_GAMES, len(FOOD)))
    assert strengths / strengths.sum() == pytest.approx(FOOD_STRENGTHS, abs=2e-6)


def test_the_order_equals_that_of_openspiel() -> None:
    """elo_test.py: wins [[0, 4, 2], [1, 0, 2], [3, 3, 0]] rank A = C > B."""
    a, b, c = fitted({(0, 1): (4, 5), (0, 2): (2, 5), (1, 2): (2, 5)}, 3)
    assert a == pytest.approx(c, abs=1e-9)
    assert b < a


def test_two_contestants_in_closed_form() -> None:
    """15 of 20 points and the prior's virtual draw: 15.5 of 21."""
    ratings = rate([block("league@1", RANDOM, 0.75)] * 10, RANDOM)
    assert ratings["league@1"].elo == pytest.approx(400 * math.log10(15.5 / 5.5), abs=0.01)


def test_the_anchor_is_zero_without_an_interval() -> None:
    anchor = rate([block("league@1", RANDOM, 0.75)] * 10, RANDOM)[RANDOM]
    assert close(anchor, Rating(0.0, 0.0, 0.0))


def test_an_undefeated_contestant_has_a_finite_rating_and_a_wide_interval() -> None:
    rating = rate([block("league@1", RANDOM, 1.0)] * 100, RANDOM)["league@1"]
    assert rating.elo is not None
    assert rating.low is not None
    assert rating.high is not None
    assert rating.low < rating.elo < rating.high < 5000
    assert rating.high - rating.low > 300


def test_contestants_not_connected_to_the_anchor_have_no_rating() -> None:
    ratings = rate([block("league@1", RANDOM, 0.5), block("league@2", "league@3", 1.0)], RANDOM)
    assert ratings["league@1"].elo is not None
    assert ratings["league@2"].elo is ratings["league@3"].low is None


def test_contestants_connected_indirectly_are_rated() -> None:
    ratings = rate([*[block("league@1", RANDOM, 0.75)] * 50, *[block("league@2", "league@1", 0.75)] * 50], RANDOM)
    assert ratings["league@2"].elo == pytest.approx(2 * (ratings["league@1"].elo or 0), abs=0.1)


def test_without_results_only_the_anchor_is_rated() -> None:
    assert list(rate([], RANDOM)) == [RANDOM]


def test_blocks_against_oneself_are_ignored() -> None:
    blocks = [block("league@1", RANDOM, 0.75)] * 10
    assert close(rate([*blocks, *[block("league@1", "league@1", 0.5)] * 5], RANDOM), rate(blocks, RANDOM))


@settings(max_examples=15, deadline=None)
@given(st.randoms(use_true_random=False))
def test_ratings_do_not_depend_on_the_order_of_blocks(random: object) -> None:
    blocks = simulated([0, 50, 120, 90], 10, np.random.default_rng(3))
    shuffled = list(blocks)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    reversed_blocks = [Outcome(b.contestants[::-1], b.games, b.scores[::-1]) for b in shuffled]
    assert close(rate(reversed_blocks, RANDOM, resamples=50), rate(blocks, RANDOM, resamples=50))


def test_the_seed_affects_the_interval_only() -> None:
    blocks = simulated([0, 50], 20, np.random.default_rng(4))
    one, two = (rate(blocks, RANDOM, seed=seed)["league@1"] for seed in (1, 2))
    assert one.elo == pytest.approx(two.elo)
    assert one != two


def test_resamples_fitted_together_equal_those_fitted_separately() -> None:
    rng = np.random.default_rng(5)
    pairs = np.array([(i, j) for i in range(8) for j in range(i + 1, 8)])
    games = rng.gamma(5, size=(60, len(pairs)))
    points = games * rng.beta(0.4, 0.4, size=games.shape)
    together = bradley_terry(points, games, pairs, 8, anchor=2)
    alone = [bradley_terry(points[i : i + 1], games[i : i + 1], pairs, 8, anchor=2)[0] for i in range(60)]
    assert np.abs(together - alone).max() * ELO < 0.01


def test_resamples_of_few_and_lopsided_blocks_converge() -> None:
    """At the solution the gradient is zero, even far from the initial values."""
    rng = np.random.default_rng(8)
    pairs = np.array([(i, j) for i in range(30) for j in range(i + 1, min(30, i + 3))])
    games = rng.gamma(0.3, size=(200, len(pairs))) + 0.05
    points = games * rng.beta(0.1, 0.1, size=games.shape).clip(0.01, 0.99)
    theta = bradley_terry(points, games, pairs, 30, anchor=3)
    gap = theta[:, pairs[:, 0]] - theta[:, pairs[:, 1]]
    left = points - games / (1 + np.exp(-gap))
    gradient = np.zeros_like(theta)
    np.add.at(gradient.T, pairs[:, 0], left.T)
    np.subtract.at(gradient.T, pairs[:, 1], left.T)
    assert np.abs(np.delete(gradient, 3, axis=1)).max() < 1e-4
    assert close(theta[:, 3], np.zeros(len(theta)))


def test_intervals_of_large_tables_approximate_the_bootstrap(monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = simulated([10.0 * i for i in range(60)], 4, np.random.default_rng(9))
    refitted = rate(blocks, RANDOM)
    monkeypatch.setattr("evaluation.statistics.bradley_terry.MOST_CELLS", 0)
    at_once = rate(blocks, RANDOM)
    bounds = np.array([[(r.low, r.high) for r in each.values() if r.elo] for each in (refitted, at_once)], dtype=float)
    assert bounds.shape == (2, 59, 2)
    off = np.abs(bounds[0] - bounds[1]) / np.diff(bounds[0], axis=1)
    assert off.mean() < 0.03
    assert off.max() < 0.1
    assert close([r.elo for r in at_once.values()], [r.elo for r in refitted.values()])
    assert close((at_once[RANDOM].low, at_once[RANDOM].high), (0.0, 0.0))


def test_intervals_have_their_coverage() -> None:
    """95 % intervals of 3 contestants, 200 blocks per pair, in 150 leagues, with binomial error."""
    rng, truth = np.random.default_rng(6), [0.0, 60.0, 150.0]
    hits = 0
    for _ in range(150):
        ratings = rate(simulated(truth, 200, rng), RANDOM, resamples=400)
        for name, elo in (("league@1", truth[1]), ("league@2", truth[2])):
            low, high = ratings[name].low, ratings[name].high
            assert low is not None
            assert high is not None
            hits += low <= elo <= high
    assert 0.91 <= hits / 300 <= 0.985
