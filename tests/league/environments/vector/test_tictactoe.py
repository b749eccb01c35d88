import itertools

import pytest
from hypothesis import given, settings

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import compare
from league.environments.vector.tictactoe import LINES, TicTacToe
from league.environments.vector.vector_env import AgentRows, UnsupportedArguments
from tests.support.environments.plans import Plan, assert_equal, last_rows, plans

CONFIG = EnvironmentConfig(entry_point="pettingzoo.classic.tictactoe_v3")


@settings(max_examples=60)
@given(plans)
def test_all_reports_equal_those_of_the_stock_environment(plan: Plan) -> None:
    assert_equal(CONFIG, TicTacToe(plan.num_envs), plan)


@pytest.mark.slow
def test_many_steps_equal_those_of_the_stock_environment() -> None:
    found = compare(CONFIG, TicTacToe(256), 200_000, seed=1)
    assert found.difference is None
    assert found.episodes > 20_000


def played(cells: list[int]) -> AgentRows:
    return last_rows(CONFIG, TicTacToe(1), cells)


def game(line: tuple[int, ...], player: int, last: int) -> list[int]:
    """Cells of a game in which `player` completes `line`, with the cell `line[last]` as its last move."""
    own = [*(cell for cell in line if cell != line[last]), line[last]]
    others = [cell for cell in range(9) if cell not in line]
    # Three cells of the other player that are no line themselves.
    other = next(list(chosen) for chosen in itertools.permutations(others, 3) if tuple(sorted(chosen)) not in LINES)
    pairs = zip(own, other, strict=True) if player == 0 else zip(other, own, strict=True)
    moves = [cell for pair in pairs for cell in pair]
    return moves[:5] if player == 0 else moves


@pytest.mark.parametrize("player", [0, 1])
@pytest.mark.parametrize("line", LINES)
def test_each_line_wins_whichever_cell_is_last(line: tuple[int, ...], player: int) -> None:
    for last in range(3):
        rows = played(game(line, player, last))
        assert rows.agents.tolist() == [1 - player, player], "the loser's row is the first"
        assert rows.rewards.tolist() == [-1, 1]
        assert rows.terminations.all()


def test_a_full_board_without_a_line_is_a_draw() -> None:
    rows = played([0, 1, 2, 4, 3, 5, 7, 6, 8])
    assert rows.agents.tolist() == [1, 0]
    assert rows.rewards.tolist() == [0, 0]
    assert not rows.observations["action_mask"].any()


def test_the_last_cell_can_win() -> None:
    rows = played([0, 1, 2, 3, 4, 5, 7, 6, 8])
    assert rows.rewards.tolist() == [-1, 1]


def test_arguments_of_the_picture_are_left_to_the_stock_environment() -> None:
    with pytest.raises(UnsupportedArguments, match="screen_height"):
        TicTacToe(1, screen_height=200)
