from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.schedules.builders import game_plans, round_robin
from league.environments.building import interface
from tests.support.leagues.tictactoe import config

SCHEDULE = round_robin(config(), interface(config()), ["tictactoe@1", "tictactoe@2", "script:random"], 10)


@given(st.integers(0, SCHEDULE.length - 1))
def test_each_contestant_plays_each_side_once_with_one_seed(position: int) -> None:
    games = game_plans(SCHEDULE, position)
    assert [game.sides for game in games] == [(0, 1), (1, 0)]
    assert {game.seed for game in games} == {SCHEDULE.seed_at(position)}
    assert {game.contestants for game in games} == {SCHEDULE.contestants_at(position)}


@given(st.integers(1, 7), st.integers(0, SCHEDULE.length - 1))
def test_a_block_is_symmetric_in_its_contestants(sides: int, position: int) -> None:
    """Game 1 is game 0 with the contestants exchanged, so that each of them plays each side."""
    schedule = replace(SCHEDULE, sides=tuple(f"side_{i}" for i in range(sides)))
    first, second = game_plans(schedule, position)
    assert second.sides == tuple(1 - contestant for contestant in first.sides)
    assert first.sides.count(0) == 1
    assert first.sides.index(0) == schedule.seat_at(position)


@pytest.mark.parametrize("sides", [1, 3, 5])
def test_the_side_rotates_with_the_rounds(sides: int) -> None:
    schedule = replace(SCHEDULE, sides=tuple(f"side_{i}" for i in range(sides)))
    rounds = [[schedule.seat_at(3 * turn + pairing) for pairing in range(3)] for turn in range(10)]
    assert rounds == [[turn % sides] * 3 for turn in range(10)]


def test_openings_are_shared_by_a_block_and_policy_draws_are_not() -> None:
    first, second = game_plans(SCHEDULE, 0)
    assert first.opening(0, 1).random() == second.opening(0, 1).random()
    streams = [game.policy(agent) for game in (first, second) for agent in (0, 1)]
    streams += [first.opening(attempt, agent) for attempt in (0, 1) for agent in (0, 1)]
    assert len({stream.random() for stream in streams}) == 8
