"""Ratings by Bradley and Terry."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import combinations
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.statistics.bradley_terry import ELO, Rating, posterior, rate, virtual_draws
from evaluation.statistics.sequential import (
    score_of,
)
from league.results.records import Outcome
from tests.support.closeness import close
from tests.support.examples import examples

RANDOM = "script:random"


# Wins, with ties as halves, of evalica's food.csv: pair → score of the first, games.
FOOD_RESULTS = [(1, 2), (1, 2), (4, 5), (4, 4), (4, 6), (1.5, 2), (0, 2), (0, 2), (3, 3), (0.5, 2)]


FOOD_GAMES = dict(zip(combinations(range(5), 2), FOOD_RESULTS, strict=True))


FOOD_STRENGTHS = (0.434290, 0.190600, 0.147977, 0.128153, 0.098980)
"""Tacos, sushi, burger, pasta and pizza."""


def block(first: str, second: str, score: float, games: int = 2) -> Outcome:
    """A block with this mean score of the first contestant."""
    points = (score * games, (1 - score) * games)
    return Outcome((first, second), games, points)


def fitted(games: dict[tuple[int, int], tuple[float, float]], size: int) -> np.ndarray:
    """Log odds from so many games that the prior does not matter. games: pair → score of the first, games."""
    points, played = np.zeros((2, size, size))
    for (i, j), (score, number) in games.items():
        points[i, j], points[j, i] = 1e6 * score, 1e6 * (number - score)
        played[i, j] = played[j, i] = 1e6 * number
    return posterior(points, played)[0]


def expected(elos: Sequence[float], pairs: Iterable[tuple[int, int]], matches: int) -> list[Outcome]:
    """Matches of two games whose scores are the expected ones. Contestant 0 is `script:random`."""
    names = [RANDOM, *(f"league@{i}" for i in range(1, len(elos)))]
    scores = {(i, j): float(score_of(elos[i] - elos[j])) for i, j in pairs}
    return [Outcome((names[i], names[j]), 2, (2 * x, 2 - 2 * x), matches) for (i, j), x in scores.items()]


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


def test_strengths_equal_those_of_evalica_and_the_order_that_of_openspiel() -> None:
    """elo_test.py: wins [[0, 4, 2], [1, 0, 2], [3, 3, 0]] rank A = C > B."""
    strengths = np.exp(fitted(FOOD_GAMES, len(FOOD_STRENGTHS)))
    assert strengths / strengths.sum() == pytest.approx(FOOD_STRENGTHS, abs=2e-6)
    a, b, c = fitted({(0, 1): (4, 5), (0, 2): (2, 5), (1, 2): (2, 5)}, 3)
    assert a == pytest.approx(c, abs=1e-9)
    assert b < a


def test_two_contestants_in_closed_form() -> None:
    """15 of 20 points and the virtual draw: 15.5 of 21. The anchor is zero without an interval."""
    blocks = [block("league@1", RANDOM, 0.75)] * 10
    ratings = rate(blocks, RANDOM)
    assert ratings["league@1"].elo == pytest.approx(400 * math.log10(15.5 / 5.5), abs=0.01)
    assert close(ratings[RANDOM], Rating(0.0, 0.0, 0.0))
    assert list(rate([], RANDOM)) == [RANDOM]
    against_itself = [block("league@1", "league@1", 0.5)] * 5
    assert close(rate([*blocks, *against_itself], RANDOM), ratings), "is ignored"


def test_an_undefeated_contestant_has_a_finite_rating_and_a_wide_interval() -> None:
    rating = rate([block("league@1", RANDOM, 1.0)] * 100, RANDOM)["league@1"]
    assert rating.low < rating.elo < rating.high < 5000
    assert rating.high - rating.low > 300


def test_contestants_that_are_connected_to_the_anchor_are_rated() -> None:
    ratings = rate([block("league@1", RANDOM, 0.5), block("league@2", "league@3", 1.0)], RANDOM)
    assert ratings["league@1"].elo is not None
    assert ratings["league@2"].elo is ratings["league@3"].low is None
    ratings = rate([*[block("league@1", RANDOM, 0.75)] * 50, *[block("league@2", "league@1", 0.75)] * 50], RANDOM)
    assert ratings["league@2"].elo == pytest.approx(2 * (ratings["league@1"].elo or 0), abs=0.1)


@examples(15)
@given(st.randoms(use_true_random=False))
def test_ratings_do_not_depend_on_the_order_of_blocks(random: Random) -> None:
    """Equal ones may be summed up."""
    blocks = simulated([0, 50, 120, 90], 10, np.random.default_rng(3))
    shuffled = list(blocks)
    random.shuffle(shuffled)
    reversed_blocks = [Outcome(b.contestants[::-1], b.games, b.scores[::-1]) for b in shuffled]
    assert close(rate(reversed_blocks, RANDOM), rate(blocks, RANDOM))
    summed = [Outcome(b.contestants, b.games, b.scores, number) for b, number in Counter(shuffled).items()]
    assert close(rate(summed, RANDOM), rate(blocks, RANDOM))


def test_a_fit_of_many_games_ends() -> None:
    """Rounding does not keep it from converging, nor do games of others that no chain connects to the anchor."""
    elos = [0.0, 500.0, 1000.0]
    for matches in (10**number for number in range(4, 12)):
        unconnected = [Outcome(("league@8", "league@9"), 2, (2.0, 0.0), matches), block("league@8", "league@9", 0.0)]
        ratings = rate([*expected(elos, combinations(range(3), 2), matches), *unconnected], RANDOM)
        assert [ratings[f"league@{i}"].elo for i in (1, 2)] == pytest.approx(elos[1:], abs=0.5)
        assert ratings["league@9"].elo is None


@given(st.integers(0, 10_000))
def test_few_and_lopsided_games_are_fitted(seed: int) -> None:
    """At the solution the gradient is zero, even far from the initial values."""
    rng = np.random.default_rng(seed)
    games = np.triu(rng.gamma(0.3, size=(30, 30)) + 0.05, 1) * (rng.random((30, 30)) < 0.2)
    points = games * rng.beta(0.1, 0.1, size=games.shape)
    points, games = points + (games - points).T, games + games.T
    strength, draws = posterior(points, games)[0], virtual_draws(games)
    scored = 1 / (1 + np.exp(strength - strength[:, None]))
    assert np.abs((points + draws / 2 - (games + draws) * scored).sum(axis=1)).max() < 0.02


@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(1, 10_000)), min_size=1))
def test_the_prior_is_at_most_one_game_of_each_contestant(played: list[tuple[int, int, int]]) -> None:
    games = np.zeros((10, 10))
    for i, j, number in played:
        if i != j:
            games[i, j] += number
            games[j, i] += number
    draws = virtual_draws(games)
    assert close(draws, draws.T)
    assert (draws.sum(axis=1) <= 1 + 1e-9).all()
    assert ((draws > 0) == (games > 0)).all()


def test_a_ladder_keeps_its_distances() -> None:
    """The best is not too close to the others, from the expected scores of 16 matches a pair: one virtual draw per pair
    would cost 240 Elo. Nor are versions that met only their predecessors: N(0, (600 Elo)²) of each would cost 150.
    """
    for size, spread in ((8, 1200), (20, 1500), (60, 1500)):
        elos = np.linspace(0, spread, size)
        best = rate(expected(elos, combinations(range(size), 2), 16), RANDOM)[f"league@{size - 1}"].elo
        assert best == pytest.approx(spread, abs=30)
    pairs = [(max(0, i - k), i) for i in range(1, 60) for k in (1, 2, 3) if k <= i]
    best = rate(expected(np.linspace(0, 1500, 60), pairs, 16), RANDOM)["league@59"].elo
    assert best == pytest.approx(1500, abs=20)


def test_the_interval_is_that_of_the_mean_score() -> None:
    """Of one pair with many blocks, by the delta method: the deviation of a block's points over their slope. Two drawn
    matches do not vary, which does not show that others would not: their interval is almost that of the model.
    """
    blocks = [*[block("league@1", RANDOM, 1.0)] * 300, *[block("league@1", RANDOM, 0.5)] * 700]
    rating, score, variance = rate(blocks, RANDOM)["league@1"], 0.65, 0.3 * 0.7 / 4
    half = 1.96 * ELO * math.sqrt(variance / 1000) / (score * (1 - score))
    assert rating.high - rating.elo == pytest.approx(half, rel=0.02)
    of_model = 1.96 * ELO / math.sqrt(4 * 0.25)
    assert 0.6 * of_model < rate([block("league@1", RANDOM, 0.5)] * 2, RANDOM)["league@1"].high < of_model


def test_an_advantage_of_a_side_narrows_intervals() -> None:
    """If the first move wins, all blocks are 1:1, and say more about the difference than decisive games."""
    pairs = [("league@1", RANDOM), ("league@2", RANDOM), ("league@1", "league@2")]
    even = [block(*pair, 0.5) for pair in pairs for _ in range(50)]
    decisive = [block(*pair, score) for pair in pairs for score in (0.0, 1.0) for _ in range(25)]
    widths = [r.high - r.low for r in (rate(blocks, RANDOM)["league@1"] for blocks in (even, decisive))]  # type: ignore[operator]
    assert widths[0] < 0.5 * widths[1]


@pytest.mark.parametrize(("elos", "blocks"), [((0, 60, 150), 200), (tuple(np.linspace(0, 1500, 20)), 16)])
def test_intervals_have_their_coverage(elos: Sequence[float], blocks: int) -> None:
    """95 % intervals of 150 leagues, with binomial error."""
    rng, hits, number = np.random.default_rng(6), 0, 150
    for _ in range(number):
        ratings = rate(simulated(elos, blocks, rng), RANDOM)
        for i, elo in enumerate(elos[1:], start=1):
            rating = ratings[f"league@{i}"]
            hits += rating.low <= elo <= rating.high
    assert 0.92 <= hits / (number * (len(elos) - 1)) <= 0.98
