"""Games of two players: all reports equal those of the stock environment, and the rules."""

import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.vector.connect_four import COLUMNS, ROWS, STRIDE, ConnectFour, has_four
from league.environments.vector.equality import compare
from league.environments.vector.leduc_holdem import LeducHoldem
from league.environments.vector.rps import RockPaperScissors
from league.environments.vector.tictactoe import LINES, TicTacToe
from league.environments.vector.vector_env import AgentRows, UnsupportedArguments
from tests.support.environments.plans import Plan, assert_equal, last_rows, plans

CELLS = list(itertools.product(range(COLUMNS), range(ROWS)))


DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))


FOURS = [
    line
    for (column, row), (right, up) in itertools.product(CELLS, DIRECTIONS)
    if set(line := tuple((column + i * right, row + i * up) for i in range(4))) <= set(CELLS)
]


def board(cells: set[tuple[int, int]]) -> int:
    return sum(1 << (column * STRIDE + row) for column, row in cells)


def four(*boards: int) -> list[bool]:
    return has_four(np.array(boards, dtype=np.uint64)).tolist()


def test_each_of_the_69_lines_is_a_four_and_no_part_of_it() -> None:
    assert len(FOURS) == 69
    assert all(four(*(board(set(line)) for line in FOURS)))
    parts = [set(line) - {cell} for line in FOURS for cell in line]
    assert not any(four(*map(board, parts)))


def test_no_other_four_cells_are_a_four() -> None:
    """Neither across the top of a column and the bottom of the next one, nor across the sides."""
    bits = [board({cell}) for cell in CELLS]
    found = has_four(np.array([sum(cells) for cells in itertools.combinations(bits, 4)], dtype=np.uint64))
    assert found.sum() == 69


@given(st.sets(st.sampled_from(CELLS)))
def test_boards_have_a_four_if_they_contain_a_line(cells: set[tuple[int, int]]) -> None:
    assert four(board(cells)) == [any(set(line) <= cells for line in FOURS)]


def moves_to(line: tuple[int, ...], player: int, last: int) -> list[int]:
    """Cells of a game in which `player` completes `line`, with the cell `line[last]` as its last move."""
    own = [*(cell for cell in line if cell != line[last]), line[last]]
    others = [cell for cell in range(9) if cell not in line]
    # Three cells of the other player that are no line themselves.
    other = next(list(chosen) for chosen in itertools.permutations(others, 3) if tuple(sorted(chosen)) not in LINES)
    pairs = zip(own, other, strict=True) if player == 0 else zip(other, own, strict=True)
    moves = [cell for pair in pairs for cell in pair]
    return moves[:5] if player == 0 else moves


STOCK = {
    ConnectFour: "connect_four_v3",
    TicTacToe: "tictactoe_v3",
    RockPaperScissors: "rps_v2",
    LeducHoldem: "leduc_holdem_v4",
}


GAMES = sorted(STOCK, key=str)


RPS_ARGUMENTS = st.fixed_dictionaries(
    {}, optional={"num_actions": st.sampled_from([3, 5, 7]), "max_cycles": st.integers(1, 6)}
)


def config(game: Any, **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=f"pettingzoo.classic.{STOCK[game]}", kwargs=kwargs)


@pytest.mark.parametrize("game", GAMES)
@settings(max_examples=60)
@given(plan=plans, arguments=RPS_ARGUMENTS)
def test_all_reports_equal_those_of_the_stock_environment(game: Any, plan: Plan, arguments: dict[str, int]) -> None:
    kwargs = arguments if game is RockPaperScissors else {}
    assert_equal(config(game, **kwargs), game(plan.num_envs, **kwargs), plan)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("game", "kwargs", "episodes"),
    [
        (ConnectFour, {}, 6_000),
        (TicTacToe, {}, 20_000),
        (LeducHoldem, {}, 20_000),
        (RockPaperScissors, {}, 5_000),
        (RockPaperScissors, {"num_actions": 5, "max_cycles": 4}, 5_000),
    ],
)
def test_many_steps_equal_those_of_the_stock_environment(game: Any, kwargs: dict[str, int], episodes: int) -> None:
    comparison = compare(config(game, **kwargs), game(256, **kwargs), 200_000, seed=1)
    assert comparison.difference is None
    assert comparison.episodes > episodes


def test_other_arguments_are_left_to_the_stock_environment() -> None:
    names = ["num_actions", "num_actions", "max_cycles", "screen_height"]
    for game, name, value in (
        (ConnectFour, "screen_scaling", 3),
        (TicTacToe, "screen_height", 200),
        *((LeducHoldem, name, 2) for name in ("num_players", "render_mode", "screen_height")),
        *zip([RockPaperScissors] * 4, names, [4, 1, None, 100], strict=True),
    ):
        with pytest.raises(UnsupportedArguments, match=name):
            game(1, **{name: value})


def played(game: Any, actions: Iterable[int]) -> AgentRows:
    return last_rows(config(game), game(1), list(actions))


def assert_won(rows: AgentRows, winner: int) -> None:
    assert rows.agents.tolist() == [1 - winner, winner], "the loser's row is the first"
    assert rows.rewards.tolist() == [-1, 1]
    assert rows.terminations.all()
    assert not rows.truncations.any()


def test_wins_are_rewarded(subtests: pytest.Subtests) -> None:
    for columns, winner in (
        ("0101010", 0),  # vertical, left edge
        ("6060606", 0),  # vertical, right edge
        ("50606060", 1),  # vertical, second player
        ("0011223", 0),  # horizontal, bottom left
        ("3344556", 0),  # horizontal, bottom right
        ("01122323363", 0),  # diagonal, upwards from the corner
        ("65544343303", 0),  # diagonal, downwards to the corner
        ("460265125234114035562430131501302624304665", 1),  # by the last move
    ):
        with subtests.test(columns=columns):
            assert_won(played(ConnectFour, map(int, columns)), winner)


def test_each_line_of_tic_tac_toe_wins_whichever_cell_is_last() -> None:
    for line, player, last in itertools.product(LINES, range(2), range(3)):
        assert_won(played(TicTacToe, moves_to(line, player, last)), player)
    assert_won(played(TicTacToe, [0, 1, 2, 3, 4, 5, 7, 6, 8]), 0)


def test_a_full_board_without_a_line_is_a_draw() -> None:
    four = played(ConnectFour, map(int, "545062455041104565311226266362030334314210"))
    assert four.observations["observation"].sum(axis=(1, 2, 3)).tolist() == [42, 42]
    for rows, agents in ((four, [0, 1]), (played(TicTacToe, [0, 1, 2, 4, 3, 5, 7, 6, 8]), [1, 0])):
        assert rows.agents.tolist() == agents
        assert rows.rewards.tolist() == [0, 0]
        assert rows.terminations.all()
        assert not rows.observations["action_mask"].any()


def test_rock_paper_scissors() -> None:
    env, copies = RockPaperScissors(9, max_cycles=3), np.arange(9)
    env.reset(copies, copies)
    actions = np.array(list(itertools.product(range(3), repeat=2)))
    for is_last in (False, False, True):
        (rows,) = env.step(copies, actions.ravel())
        # Rock (0) loses to paper (1), paper to scissors (2), scissors to rock.
        assert rows.rewards[::2].tolist() == [0, -1, 1, 1, 0, -1, -1, 1, 0]
        assert (rows.rewards[1::2] == -rows.rewards[::2]).all()
        assert not np.signbit(rows.rewards[rows.rewards == 0]).any()
        assert rows.observations["observation"].tolist() == actions[:, ::-1].ravel().tolist()
        assert (rows.truncations == is_last).all()
        assert not rows.terminations.any()
