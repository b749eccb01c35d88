"""Schedules: who plays whom, from which seeds and seats, and when a tournament ends."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit

from evaluation.schedules.adaptive_pairing import choose, ring, round_size, tally
from evaluation.schedules.builders import game_plans, gauntlet, round_robin, verdict
from evaluation.schedules.tournament_plan import CHECK_GROWTH, Budget, StoppingRule, TournamentPlan, plan_tournament
from evaluation.statistics.bradley_terry import posterior
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, EnvironmentMismatch, InvalidInput
from league.results.records import BlockResult, Match, Schedule
from league.results.scoring import scoring
from tests.support.closeness import close
from tests.support.leagues.payoff_matches import match
from tests.support.leagues.schedules import CONFIG, INTERFACE
from tests.support.leagues.tictactoe import config

REFS = ("tictactoe@1", "script:random")


SCHEDULE = round_robin(CONFIG, INTERFACE, ["tictactoe@1", "tictactoe@2", "script:random"], 10)


names = st.lists(st.from_regex(r"tictactoe@[1-9]", fullmatch=True), min_size=2, max_size=6, unique=True)


positions = st.lists(st.integers(0, SCHEDULE.length - 1), max_size=6)


def pair_counts(schedule: Schedule, until: int | None = None) -> Counter[frozenset[str]]:
    positions = range(schedule.length if until is None else until)
    return Counter(frozenset(schedule.contestants_at(position)) for position in positions)


@given(names, st.integers(1, 5))
def test_a_round_robin_is_balanced_after_each_round(contestants: list[str], blocks: int) -> None:
    schedule = round_robin(CONFIG, INTERFACE, contestants, blocks)
    pairs = {frozenset(pair) for pair in combinations(contestants, 2)}
    for rounds in range(1, blocks + 1):
        assert pair_counts(schedule, rounds * len(pairs)) == dict.fromkeys(pairs, rounds)
    assert schedule.length == blocks * len(pairs)


@given(names, names, st.integers(1, 3))
def test_in_a_gauntlet_each_challenger_meets_each_opponent(a: list[str], b: list[str], blocks: int) -> None:
    schedule = gauntlet(CONFIG, INTERFACE, a, b, blocks)
    assert pair_counts(schedule) == {frozenset((x, y)): blocks for x in a for y in b if x != y}


def test_a_verdict_has_two_contestants_and_the_length_of_the_gate() -> None:
    schedule = verdict(CONFIG, INTERFACE, "tictactoe@2", "tictactoe@1")
    assert schedule.length == CONFIG.gate.max_blocks
    assert pair_counts(schedule) == {frozenset({"tictactoe@1", "tictactoe@2"}): schedule.length}
    assert schedule.contestants[0] == "tictactoe@2"


def test_each_setting_of_the_games_changes_id_and_seed() -> None:
    schedule = round_robin(CONFIG, INTERFACE, REFS, 3)
    assert round_robin(CONFIG, INTERFACE, REFS, 3) == schedule
    for other in (
        round_robin(CONFIG, INTERFACE, REFS, 3, seed=1),
        round_robin(CONFIG, INTERFACE, REFS, 4),
        round_robin(CONFIG, INTERFACE, ["tictactoe@2", "script:random"], 3),
        round_robin(config(play={"opening_plies": 3}), INTERFACE, REFS, 3),
        verdict(CONFIG, INTERFACE, *REFS),
    ):
        assert schedule.id != other.id
        assert schedule.seed != other.seed
    other = config(gate={"elo1": 50, "max_blocks": CONFIG.gate.max_blocks})
    assert len({verdict(league, INTERFACE, *REFS).id for league in (CONFIG, other)}) == 2
    many = round_robin(CONFIG, INTERFACE, REFS, 500)
    assert len({many.seed_at(position) for position in range(500)}) == 500


def test_equal_sides_are_compared_within_a_game_and_others_by_side() -> None:
    """In general-sum games the amount of the return may matter more than who gets more: this can be configured."""
    assert round_robin(CONFIG, INTERFACE, REFS, 3).scoring == "game"
    one: LeagueConfig = config(sides={"both": ["player_*"]})
    assert round_robin(one, interface(one), REFS, 3).scoring == "side"
    assert round_robin(config(play={"scoring": "side"}), INTERFACE, REFS, 3).scoring == "side"
    invalid: LeagueConfig = config(play={"scoring": "game"}, sides={"both": ["player_*"]})
    with pytest.raises(ConfigError, match=r"play\.scoring: game compares the sides"):
        round_robin(invalid, interface(invalid), REFS, 3)
    roles, shared = {"adversary": ["adversary_*"], "good": ["agent_*"]}, {"shared": ["*"]}
    for name, policies, sides, expected in (
        ("simple_spread", shared, None, "game"),
        ("simple_spread", shared, {"team": ["*"]}, "side"),
        ("simple_push", roles, None, "side"),
        ("simple_adversary", roles, {"adversary": ["adversary_*"], "good": ["*"]}, "side"),
        ("simple", shared, None, "side"),
    ):
        environment = {"entry_point": f"mpe2.{name}_v3"}
        document = {"league": "mpe", "environment": environment, "policies": policies, "sides": sides}
        league = LeagueConfig.from_mapping(document)
        assert scoring(league, interface(league)) == expected, name


@given(positions)
def test_each_contestant_plays_each_side_once_with_one_seed(positions: list[int]) -> None:
    plans = game_plans(SCHEDULE, positions)
    assert len(plans) == 2 * len(positions)
    assert plans.positions.tolist() == [position for position in positions for _ in range(2)]
    assert plans.indices.tolist() == [0, 1] * len(positions)
    assert plans.sides.tolist() == [[0, 1], [1, 0]] * len(positions)
    assert plans.seeds.tolist() == [SCHEDULE.seed_at(position) for position in plans.positions.tolist()]
    for position, contestants in zip(plans.positions.tolist(), plans.contestants.tolist(), strict=True):
        assert tuple(SCHEDULE.contestants[index] for index in contestants) == SCHEDULE.contestants_at(position)


@given(st.integers(1, 7), positions)
def test_games_have_the_seating_of_the_schedule_and_blocks_are_symmetric(sides: int, positions: list[int]) -> None:
    """Game 1 is game 0 with the contestants exchanged, so that each of them plays each side. Seats rotate."""
    schedule = replace(SCHEDULE, sides=tuple(f"side_{i}" for i in range(sides)))
    seatings = [tuple(seating) for seating in game_plans(schedule, positions).sides.tolist()]
    assert seatings == [schedule.seating_at(position, index) for position in positions for index in range(2)]
    for position, first, second in zip(positions, seatings[::2], seatings[1::2], strict=True):
        assert second == tuple(1 - contestant for contestant in first)
        assert first.count(0) == 1
        assert first.index(0) == schedule.seat_at(position)
    rounds = [[schedule.seat_at(3 * turn + pairing) for pairing in range(3)] for turn in range(10)]
    assert sides % 2 == 0 or rounds == [[turn % sides] * 3 for turn in range(10)]


def plan(blocks: int = 1000) -> TournamentPlan:
    return plan_tournament(CONFIG, INTERFACE, "round_robin", REFS, blocks=blocks)


def matches_of(number: int) -> Sequence[Match]:
    return [match(REFS, (1, i % 2)) for i in range(number)]


def test_a_tournament_ends_with_its_games_its_schedule_or_its_minutes() -> None:
    limit = StoppingRule(Budget(games=9), plan())
    assert limit.most == 4
    assert not limit.is_reached(matches_of(3))
    assert limit.counted(matches_of(30)) == (matches_of(4), "games")
    for budget, blocks, number, reason in (
        (Budget(games=9), 1000, 4, "games"),
        (Budget(games=100, minutes=60), 5, 5, "schedule"),
        (Budget(minutes=1e-9), 1000, 3, "minutes"),
    ):
        limit = StoppingRule(budget, plan(blocks))
        assert limit.is_reached(matches_of(number))
        assert limit.counted(matches_of(number)) == (matches_of(number), reason)
    for empty in ({"games": 1}, {"minutes": 0}, {"precision": -3}):
        with pytest.raises(InvalidInput, match=next(iter(empty))):
            Budget(**empty)


def test_precision_stops_at_the_same_match_for_any_chunks() -> None:
    matches, counts = matches_of(1000), {}
    for elo in (200, 60, 50, 20):
        counts[elo] = len(StoppingRule(Budget(precision=elo), plan()).counted(matches)[0])
    assert list(counts.values()) == sorted(set(counts.values())), "a lower precision is reached earlier"
    assert 20 < counts[50] < 200
    for chunk in (1, 7, 64, 1000):
        limit, number = StoppingRule(Budget(precision=50), plan()), 0
        while not limit.is_reached(matches[:number]):
            number += chunk
        counted, stopped_by = limit.counted(matches[:number])
        assert (stopped_by, len(counted)) == ("precision", counts[50])


@pytest.mark.parametrize("kind", ["round_robin", "adaptive"])
def test_looks_are_at_ends_of_rounds_at_increasing_intervals(kind: str) -> None:
    tournament = plan_tournament(CONFIG, INTERFACE, kind, ("a", "b", "c"), blocks=4000)  # type: ignore[arg-type]
    checks = list(tournament.precision_checks())
    rounds = set()
    for end in tournament.rounds():
        rounds.add(end)
        if end >= tournament.length:
            break
    assert set(checks) <= rounds
    assert all(later >= CHECK_GROWTH * earlier for earlier, later in pairwise(checks))
    assert checks[0] == 3
    assert checks[-1] > tournament.length / 1.3


def test_an_adaptive_plan_plays_a_quarter_and_a_single_contestant_has_no_plan() -> None:
    assert plan_tournament(CONFIG, INTERFACE, "adaptive", "abcdefgh", blocks=32).length == 28 * 8
    for kind in ("round_robin", "adaptive"):
        with pytest.raises(EnvironmentMismatch, match="two contestants"):
            plan_tournament(CONFIG, INTERFACE, kind, REFS[:1])


STEP = 50 * np.log(10) / 400


def table(points: dict[tuple[int, int], tuple[float, float]], size: int) -> tuple[np.ndarray, np.ndarray]:
    """pair → score of the first contestant, games"""
    scored, games = np.zeros((2, size, size))
    for (i, j), (score, played) in points.items():
        scored[i, j], scored[j, i] = score, played - score
        games[i, j] = games[j, i] = played
    return scored, games


@given(st.integers(1, 30), st.integers(0, 5))
def test_the_first_round_connects_all_contestants(contestants: int, seed: int) -> None:
    pairs = ring(contestants, seed)
    assert len(pairs) == len(set(pairs)) == (contestants if contestants > 2 else contestants - 1)
    reached, previous = {0}, 0
    while len(reached) > previous:
        previous = len(reached)
        reached |= {one for pair in pairs for one in pair if reached & set(pair)}
    assert reached == set(range(contestants))
    assert ring(contestants, seed) == pairs


def test_games_go_to_the_pair_with_the_least_certain_order() -> None:
    """Of two uncertain pairs, to the one with fewer games. Results of neighbours do not decide: a pair that seems 150
    Elo apart, and thus in a certain order, is chosen before even ones with more games.
    """
    even, certain = (10.0, 20.0), (20.0, 20.0)
    points = {(0, 1): certain, (1, 2): even, (2, 3): certain, (0, 2): certain, (0, 3): certain, (1, 3): certain}
    assert choose(*table(points, 4), number=1) == [(1, 2)]
    points = {(0, 1): (20.0, 40.0), (2, 3): (2.0, 4.0), (1, 2): (30.0, 30.0), (0, 3): (30.0, 30.0)}
    assert choose(*table(points, 4), number=1) == [(2, 3)]
    points = {(i, j): (20.0, 40.0) for i in range(4) for j in range(i + 1, 4)} | {(0, 1): (14.0, 20.0)}
    assert (0, 1) in choose(*table(points, 4), number=2)


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
    assert {int(order[number]) for number in renamed[0]} == {i, j}


def test_results_are_added_for_both_contestants_and_rounds_grow() -> None:
    blocks = [
        BlockResult("s", 0, ("b", "a"), 2, (1.5, 0.5), (0.0, 0.0)),
        BlockResult("s", 1, ("a", "b"), 2, (1.0, 1.0), (0.0, 0.0)),
    ]
    points, games = tally({"a": 0, "b": 1}, blocks)
    assert close(points.tolist(), [[0, 1.5], [2.5, 0]])
    assert games.tolist() == [[0, 4], [4, 0]]
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
