"""Games of two players: all reports equal those of the stock environment, and the rules."""

import itertools
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.environment import EnvironmentConfig
from league.environments.equality import DifferentialTest, compare
from league.environments.vector.connect_four import COLUMNS, ROWS, STRIDE, ConnectFour, has_four
from league.environments.vector.leduc.deals import deal, fast_deal
from league.environments.vector.leduc.rules import CALL, RAISE
from league.environments.vector.leduc_holdem import LeducHoldem
from league.environments.vector.rps import RockPaperScissors
from league.environments.vector.tictactoe import TicTacToe
from league.environments.vector.vector_env import UnsupportedArguments
from league.spaces import ACTION_MASK
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
    are_fours = has_four(np.array([sum(cells) for cells in itertools.combinations(bits, 4)], dtype=np.uint64))
    assert are_fours.sum() == 69


@given(st.sets(st.sampled_from(CELLS)))
def test_boards_have_a_four_if_they_contain_a_line(cells: set[tuple[int, int]]) -> None:
    assert four(board(cells)) == [any(set(line) <= cells for line in FOURS)]


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
@settings(max_examples=30)
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


def test_the_last_square_wins_or_draws(subtests: pytest.Subtests) -> None:
    for game, moves, rewards in (
        (ConnectFour, "460265125234114035562430131501302624304665", [-1, 1]),
        (ConnectFour, "545062455041104565311226266362030334314210", [0, 0]),
        (TicTacToe, "012345768", [-1, 1]),
        (TicTacToe, "012435768", [0, 0]),
    ):
        with subtests.test(moves=moves):
            rows = last_rows(config(game), game(1), list(map(int, moves)))
            assert rows.rewards.tolist() == rewards
            assert rows.terminations.all()
            assert not rows.observations["action_mask"].any()


leduc_deals = np.transpose(deal(np.arange(2000)))


def legal_actions_after(actions: tuple[int, ...]) -> list[int]:
    """In a hand with the seed 0."""
    env, copy = LeducHoldem(1), np.array([0])
    (rows,) = env.reset(copy, copy)
    for action in actions:
        (rows,) = env.step(copy, np.array([action]))
    return np.flatnonzero(rows.observations[ACTION_MASK][0]).tolist()


def lines(actions: tuple[int, ...] = ()) -> Iterator[tuple[int, ...]]:
    """All sequences of actions in a hand that begin with `actions`."""
    legal = legal_actions_after(actions)
    for action in legal:
        yield from lines((*actions, action))
    if not legal:
        yield actions


def seed_of(small_blind: int, first: int, second: int, public: int) -> int:
    """Return a seed with this deal."""
    return int(np.flatnonzero((leduc_deals == (small_blind, first, second, public)).all(axis=1))[0])


def test_all_lines_of_leduc_holdem_with_all_deals() -> None:
    cards = [cards for cards in itertools.product(range(3), repeat=3) if len(set(cards)) > 1]
    seeds = np.array([seed_of(number % 2, *dealt) for number, dealt in enumerate(cards)])
    copies = np.arange(len(seeds))
    test = DifferentialTest(config(LeducHoldem), LeducHoldem(len(seeds)))
    every = list(lines())
    assert len(every) == 6 + 5 * 11, "6 folds in the first round, or one of 5 ways to the second with its 11"
    for actions in every:
        test.reset(copies, seeds)
        for action in actions:
            test.step(copies, np.full(len(seeds), action))
        assert test.is_over.all()
    test.finish()


def test_a_hand_with_a_fast_seed_is_the_stock_hand_with_its_deal() -> None:
    copies, seeds = np.arange(100), 2**31 - 1 - np.arange(100)
    fast, stock = LeducHoldem(100), LeducHoldem(100)
    fast.use_fast_seeds()
    reports = [
        fast.reset(copies, seeds),
        stock.reset(copies, np.array([seed_of(*hand) for hand in zip(*fast_deal(seeds), strict=True)])),
    ]
    for action in (RAISE, RAISE, CALL, RAISE, RAISE, CALL):
        for (of_fast,), (of_stock,) in [reports]:
            np.testing.assert_equal(asdict(of_fast), asdict(of_stock))
        reports = [env.step(copies, np.full(100, action)) for env in (fast, stock)]
    np.testing.assert_array_equal(reports[0][0].rewards, reports[1][0].rewards)
