import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit

from evaluation.schedules.adaptive_pairing import choose, ring, round_size, tally
from evaluation.statistics.bradley_terry import posterior
from league.results.records import BlockResult
from tests.support.closeness import close

STEP = 50 * np.log(10) / 400


def table(points: dict[tuple[int, int], tuple[float, float]], size: int) -> tuple[np.ndarray, np.ndarray]:
    """pair → score of the first contestant, games"""
    scored, games = np.zeros((2, size, size))
    for (i, j), (own, played) in points.items():
        scored[i, j], scored[j, i] = own, played - own
        games[i, j] = games[j, i] = played
    return scored, games


@given(st.integers(2, 30), st.integers(0, 5))
def test_the_first_round_connects_all_contestants(contestants: int, seed: int) -> None:
    pairs = ring(contestants, seed)
    assert len(pairs) == len(set(pairs)) == (contestants if contestants > 2 else 1)
    reached, previous = {0}, 0
    while len(reached) > previous:
        previous = len(reached)
        reached |= {one for pair in pairs for one in pair if reached & set(pair)}
    assert reached == set(range(contestants))
    assert ring(contestants, seed) == pairs


def test_a_single_contestant_has_no_pairs() -> None:
    assert ring(1, 0) == []


def test_results_of_neighbours_do_not_decide_which_of_them_play() -> None:
    """A pair that seems 150 Elo apart, and thus in a certain order, is chosen before even ones with more games."""
    points = {(i, j): (20.0, 40.0) for i in range(4) for j in range(i + 1, 4)} | {(0, 1): (14.0, 20.0)}
    assert (0, 1) in choose(*table(points, 4), number=2)


def test_games_go_to_the_pair_with_the_least_certain_order() -> None:
    even, certain = (10.0, 20.0), (20.0, 20.0)
    points = {(0, 1): certain, (1, 2): even, (2, 3): certain, (0, 2): certain, (0, 3): certain, (1, 3): certain}
    assert choose(*table(points, 4), number=1) == [(1, 2)]


def test_of_two_uncertain_pairs_the_one_with_fewer_games_is_chosen() -> None:
    points = {(0, 1): (20.0, 40.0), (2, 3): (2.0, 4.0), (1, 2): (30.0, 30.0), (0, 3): (30.0, 30.0)}
    assert choose(*table(points, 4), number=1) == [(2, 3)]


def test_a_round_is_spread_and_a_large_one_repeats_pairs() -> None:
    empty = np.zeros((6, 6))
    assert sorted(one for pair in choose(empty, empty, 3) for one in pair) == list(range(6))
    many = choose(empty, empty, 1000)
    assert len(many) == 1000
    assert len(set(many)) == 15


def test_the_numbering_of_contestants_does_not_matter() -> None:
    rng = np.random.default_rng(0)
    points = {(i, j): (float(rng.integers(0, 7)), 6.0) for i in range(5) for j in range(i + 1, 5)}
    scored, games = table(points, 5)
    order = np.array([3, 0, 4, 2, 1])
    ((i, j),) = choose(scored, games, 1)
    renamed = choose(scored[np.ix_(order, order)], games[np.ix_(order, order)], 1)
    assert {int(order[each]) for each in renamed[0]} == {i, j}


def test_results_are_added_for_both_contestants() -> None:
    blocks = [
        BlockResult("s", 0, ("b", "a"), 2, (1.5, 0.5), (0.0, 0.0)),
        BlockResult("s", 1, ("a", "b"), 2, (1.0, 1.0), (0.0, 0.0)),
    ]
    points, games = tally({"a": 0, "b": 1}, blocks)
    assert close(points.tolist(), [[0, 1.5], [2.5, 0]])
    assert games.tolist() == [[0, 4], [4, 0]]


def test_the_size_of_rounds_grows_with_the_number_of_games() -> None:
    assert [round_size(10, played) for played in (0, 100, 160, 1600)] == [10, 10, 10, 100]


def test_adaptive_pairing_orders_more_pairs_than_a_round_robin() -> None:
    """20 contestants in steps of 50 Elo, 16 games per pair, 20 repetitions."""
    size, blocks, rng = 20, 8, np.random.default_rng(1)
    truth, (first, second) = np.arange(size) * STEP, np.triu_indices(size, 1)
    wrong = {"adaptive": 0, "round robin": 0}
    for _ in range(20):
        points, games = np.zeros((2, size, size))
        while (played := int(games.sum()) // 4) < len(first) * blocks:
            number = min(round_size(size, played), len(first) * blocks - played)
            for i, j in choose(points, games, number) if played else ring(size, 0):
                won = rng.binomial(2, expit(truth[i] - truth[j]))
                points[[i, j], [j, i]] += won, 2 - won
                games[[i, j], [j, i]] += 2
        strength = posterior(points, games)[0]
        wrong["adaptive"] += int((strength[first] > strength[second]).sum())
        every = np.zeros((size, size))
        every[first, second] = rng.binomial(2 * blocks, expit(truth[first] - truth[second]))
        every[second, first] = 2 * blocks - every[first, second]
        wrong["round robin"] += int((every.sum(axis=1)[first] > every.sum(axis=1)[second]).sum())
    assert wrong["adaptive"] < 0.7 * wrong["round robin"], wrong
