from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.schedules.builders import game_plans, round_robin
from league.environments.building import interface
from tests.support.leagues.tictactoe import config

SCHEDULE = round_robin(config(), interface(config()), ["tictactoe@1", "tictactoe@2", "script:random"], 10)
positions = st.lists(st.integers(0, SCHEDULE.length - 1), max_size=6)


@given(positions)
def test_each_contestant_plays_each_side_once_with_one_seed(positions: list[int]) -> None:
    plans = game_plans(SCHEDULE, positions)
    assert len(plans) == 2 * len(positions)
    assert plans.positions.tolist() == [position for position in positions for _ in range(2)]
    assert plans.indices.tolist() == [0, 1] * len(positions)
    assert plans.sides.tolist() == [[0, 1], [1, 0]] * len(positions)
    assert plans.seeds.tolist() == [SCHEDULE.seed_at(position) for position in plans.positions.tolist()]
    for position, own in zip(plans.positions.tolist(), plans.contestants.tolist(), strict=True):
        assert tuple(SCHEDULE.contestants[index] for index in own) == SCHEDULE.contestants_at(position)


@given(st.integers(1, 7), positions)
def test_games_have_the_seating_of_the_schedule(sides: int, positions: list[int]) -> None:
    schedule = replace(SCHEDULE, sides=tuple(f"side_{i}" for i in range(sides)))
    plans = game_plans(schedule, positions)
    expected = [schedule.seating_at(position, index) for position in positions for index in range(2)]
    assert list(map(tuple, plans.sides.tolist())) == expected


@given(st.integers(1, 7), st.integers(0, SCHEDULE.length - 1))
def test_a_block_is_symmetric_in_its_contestants(sides: int, position: int) -> None:
    """Game 1 is game 0 with the contestants exchanged, so that each of them plays each side."""
    schedule = replace(SCHEDULE, sides=tuple(f"side_{i}" for i in range(sides)))
    first, second = game_plans(schedule, [position]).sides.tolist()
    assert second == [1 - contestant for contestant in first]
    assert first.count(0) == 1
    assert first.index(0) == schedule.seat_at(position)


@pytest.mark.parametrize("sides", [1, 3, 5])
def test_the_side_rotates_with_the_rounds(sides: int) -> None:
    schedule = replace(SCHEDULE, sides=tuple(f"side_{i}" for i in range(sides)))
    rounds = [[schedule.seat_at(3 * turn + pairing) for pairing in range(3)] for turn in range(10)]
    assert rounds == [[turn % sides] * 3 for turn in range(10)]
