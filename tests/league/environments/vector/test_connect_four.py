import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.vector.connect_four import COLUMNS, ROWS, STRIDE, ConnectFour, has_four
from league.environments.vector.equality import compare
from league.environments.vector.vector_env import AgentRows, UnsupportedArguments
from tests.support.environments.plans import Plan, assert_equal, last_rows, plans

CONFIG = EnvironmentConfig(entry_point="pettingzoo.classic.connect_four_v3")

CELLS = list(itertools.product(range(COLUMNS), range(ROWS)))
DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
LINES = [
    line
    for (column, row), (right, up) in itertools.product(CELLS, DIRECTIONS)
    if set(line := tuple((column + i * right, row + i * up) for i in range(4))) <= set(CELLS)
]
DRAWN = "545062455041104565311226266362030334314210"
WON_BY_THE_LAST_MOVE = "460265125234114035562430131501302624304665"


@settings(max_examples=80)
@given(plans)
def test_all_reports_equal_those_of_the_stock_environment(plan: Plan) -> None:
    assert_equal(CONFIG, ConnectFour(plan.num_envs), plan)


@pytest.mark.slow
def test_many_steps_equal_those_of_the_stock_environment() -> None:
    found = compare(CONFIG, ConnectFour(256), 200_000, seed=1)
    assert found.difference is None
    assert found.episodes > 6_000


def board(cells: set[tuple[int, int]]) -> int:
    return sum(1 << (column * STRIDE + row) for column, row in cells)


def four(*boards: int) -> list[bool]:
    return has_four(np.array(boards, dtype=np.uint64)).tolist()


def test_each_of_the_69_lines_is_a_four_and_no_part_of_it() -> None:
    assert len(LINES) == 69
    assert all(four(*(board(set(line)) for line in LINES)))
    parts = [set(line) - {cell} for line in LINES for cell in line]
    assert not any(four(*map(board, parts)))


def test_no_other_four_cells_are_a_four() -> None:
    """Neither across the top of a column and the bottom of the next one, nor across the sides."""
    bits = [board({cell}) for cell in CELLS]
    found = has_four(np.array([sum(cells) for cells in itertools.combinations(bits, 4)], dtype=np.uint64))
    assert found.sum() == 69


@given(st.sets(st.sampled_from(CELLS)))
def test_boards_have_a_four_if_they_contain_a_line(cells: set[tuple[int, int]]) -> None:
    assert four(board(cells)) == [any(set(line) <= cells for line in LINES)]


def played(columns: str) -> AgentRows:
    return last_rows(CONFIG, ConnectFour(1), list(map(int, columns)))


@pytest.mark.parametrize(
    ("columns", "winner"),
    [
        ("0101010", 0),  # vertical, left edge
        ("6060606", 0),  # vertical, right edge
        ("50606060", 1),  # vertical, second player
        ("0011223", 0),  # horizontal, bottom left
        ("3344556", 0),  # horizontal, bottom right
        ("01122323363", 0),  # diagonal, upwards from the corner
        ("65544343303", 0),  # diagonal, downwards to the corner
        (WON_BY_THE_LAST_MOVE, 1),
    ],
)
def test_wins_are_rewarded(columns: str, winner: int) -> None:
    rows = played(columns)
    assert rows.agents.tolist() == [1 - winner, winner], "the loser's row is the first"
    assert rows.rewards.tolist() == [-1, 1]
    assert rows.terminations.all()
    assert not rows.truncations.any()


def test_a_full_board_without_a_four_is_a_draw() -> None:
    rows = played(DRAWN)
    assert rows.agents.tolist() == [0, 1]
    assert rows.rewards.tolist() == [0, 0]
    assert rows.terminations.all()
    assert not rows.observations["action_mask"].any()
    assert rows.observations["observation"].sum(axis=(1, 2, 3)).tolist() == [42, 42]


def test_arguments_of_the_picture_are_left_to_the_stock_environment() -> None:
    with pytest.raises(UnsupportedArguments, match="screen_scaling"):
        ConnectFour(1, screen_scaling=3)
