"""Batched minimax, compared with a plain recursion and with the exact solver."""

from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from league.policies.line_games.game import CONNECT_FOUR, TIC_TAC_TOE
from league.policies.line_games.minimax import LOST, BatchedMinimax
from league.policies.line_games.solver import LineGameSolver
from league.policies.scripted import script
from tests.support.environments.line_games import environment_after, observations, random_moves, spaces

GAMES = {"connect_four": CONNECT_FOUR, "tictactoe": TIC_TAC_TOE}


def expected(solver: LineGameSolver, own: int, other: int, plies: int) -> dict[int, int]:
    """The values of the moves by recursion over single positions."""

    @cache
    def value(own: int, other: int, plies: int) -> int:
        if plies == 0:
            return 0
        return max(values(own, other, plies).values(), default=0)

    def values(own: int, other: int, plies: int) -> dict[int, int]:
        return {
            action: plies if solver._wins(own | move) else -value(other, own | move, plies - 1)
            for action, move in solver._moves(own | other)
        }

    return values(own, other, plies)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(GAMES)), st.integers(0, 10_000), st.integers(0, 40), st.integers(1, 4))
def test_values_equal_those_of_a_plain_recursion(name: str, seed: int, plies_played: int, plies: int) -> None:
    env = environment_after(name, random_moves(name, seed, plies_played))
    search, solver = BatchedMinimax(GAMES[name]), LineGameSolver(GAMES[name])
    own, other = search.positions(observations([env] * 2)["observation"])
    assert [int(own[0]), int(other[0])] == list(solver.position(observations([env])["observation"][0]))
    found = search.values(own, other, plies)
    wanted = np.full(GAMES[name].actions, LOST)
    for action, value in expected(solver, int(own[0]), int(other[0]), plies).items():
        wanted[action] = value
    assert found.tolist() == [wanted.tolist()] * 2


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_a_search_to_the_end_of_tic_tac_toe_is_exact(seed: int) -> None:
    env = environment_after("tictactoe", random_moves("tictactoe", seed, 4))
    search, solver = BatchedMinimax(TIC_TAC_TOE), LineGameSolver(TIC_TAC_TOE)
    own, other = search.positions(observations([env])["observation"])
    signs = np.sign(search.values(own, other, 9)[0])
    outcomes = solver.outcomes(int(own[0]), int(other[0]))
    assert {action: int(signs[action]) for action in outcomes} == outcomes


def test_four_plies_prevent_an_open_line() -> None:
    """With 2, 3 taken in the lowest row, 1 or 4 would make a line that is open at both ends."""
    env = environment_after("connect_four", [2, 2, 3])
    batch = observations([env] * 200)
    for plies, answers in ((2, {0, 1, 2, 3, 4, 5, 6}), (4, {1, 4})):
        rng = [np.random.default_rng(row) for row in range(200)]
        assert set(script(f"minimax_{plies}", *spaces(env)).act(batch, rng=rng).actions.tolist()) == answers
    for game in GAMES.values():
        search = BatchedMinimax(game)
        boards = np.zeros((0, game.rows, game.columns, 2), np.int8)
        assert search.values(*search.positions(boards), 4).shape == (0, game.actions)
