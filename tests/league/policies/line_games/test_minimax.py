"""Batched minimax, compared with a plain recursion and with the exact solver, and that one with OpenSpiel's search."""

import sys
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import pyspiel
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from open_spiel.python.algorithms.minimax import alpha_beta_search

from league.errors import ConfigError, ObservationError
from league.policies.line_games.game import CONNECT_FOUR, TIC_TAC_TOE, LineGame
from league.policies.line_games.minimax import LOST, BatchedMinimax
from league.policies.line_games.solver import MAX_EMPTY, LineGameSolver
from league.policies.scripted import script
from tests.support.environments.line_games import environment_after, legal, observations, random_moves, spaces

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
    board, opponent_board = search.positions(observations([env] * 2)["observation"])
    assert [int(board[0]), int(opponent_board[0])] == list(solver.position(observations([env])["observation"][0]))
    values_found = search.values(board, opponent_board, plies)
    values_expected = np.full(GAMES[name].actions, LOST)
    for action, value in expected(solver, int(board[0]), int(opponent_board[0]), plies).items():
        values_expected[action] = value
    assert values_found.tolist() == [values_expected.tolist()] * 2


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_a_search_to_the_end_of_tic_tac_toe_is_exact(seed: int) -> None:
    env = environment_after("tictactoe", random_moves("tictactoe", seed, 4))
    search, solver = BatchedMinimax(TIC_TAC_TOE), LineGameSolver(TIC_TAC_TOE)
    board, opponent_board = search.positions(observations([env])["observation"])
    signs = np.sign(search.values(board, opponent_board, 9)[0])
    outcomes = solver.outcomes(int(board[0]), int(opponent_board[0]))
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


def generators(rows: int) -> list[np.random.Generator]:
    return [np.random.default_rng(row) for row in range(rows)]


def test_it_is_seeded() -> None:
    env = environment_after("connect_four", [])
    batch = observations([env] * 20)
    policy = script("mcts_100", *spaces(env))
    actions = [policy.act(batch, rng=generators(20)).actions.tolist() for _ in range(2)]
    assert actions[0] == actions[1]
    assert len(set(actions[0])) > 1


def test_moves_are_legal_until_the_end_of_the_game() -> None:
    for game, plies in (("connect_four", 42), ("tictactoe", 9)):
        for seed in range(5):
            env = environment_after(game, random_moves(game, seed, plies))
            batch = observations([env])
            action = script("mcts_100", *spaces(env)).act(batch, rng=generators(1)).actions[0]
            assert batch["action_mask"][0][action] == 1


def test_it_finds_the_only_good_move() -> None:
    for game, moves, best in (
        ("connect_four", [3, 0, 3, 1, 3, 6], 3),  # wins
        ("connect_four", [0, 3, 1, 3, 6, 3], 3),  # blocks
        ("connect_four", [2, 2, 3, 3, 0], 1),  # blocks a line with a gap
        ("tictactoe", [0, 4, 8, 1], 7),  # completes a line
        ("tictactoe", [0], 4),  # takes the centre
    ):
        env = environment_after(game, moves)
        policy = script("mcts_1000", *spaces(env))
        assert set(policy.act(observations([env] * 5), rng=generators(5)).actions.tolist()) == {best}


def test_faults_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    env = environment_after("connect_four", [])
    batch = observations([env])
    batch["observation"][0, 5, :3, 0] = 1
    with pytest.raises(ObservationError, match="not a position of connect_four: 3 own pieces and 0 of the opponent"):
        script("mcts_100", *spaces(env)).act(batch, rng=generators(1))
    monkeypatch.setitem(sys.modules, "pyspiel", None)
    with pytest.raises(ConfigError, match=r"script:mcts_100 needs OpenSpiel: pip install 'policy-league\[openspiel\]'"):
        script("mcts_100", *spaces(env))


def outcomes(game: LineGame, env: Any) -> dict[int, int]:
    solver = LineGameSolver(game)
    return solver.outcomes(*solver.position(observations([env])["observation"][0]))


def expected_outcomes(name: str, moves: Sequence[int]) -> dict[int, int]:
    rules = pyspiel.load_game(name)
    state = rules.new_initial_state()
    for move in moves:
        state.apply_action(move)
    player = state.current_player()
    return {
        action: int(alpha_beta_search(rules, state.child(action), maximizing_player_id=player)[0])
        for action in state.legal_actions()
    }


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 8) | st.just(0))
def test_outcomes_of_tic_tac_toe_equal_those_of_minimax(seed: int, plies: int) -> None:
    moves = random_moves("tictactoe", seed, plies)
    assert outcomes(TIC_TAC_TOE, environment_after("tictactoe", moves)) == expected_outcomes("tic_tac_toe", moves)


def test_it_plays_each_of_the_best_actions() -> None:
    """After a corner, only the centre draws in tic-tac-toe; the answer to the centre is any corner."""
    for moves, best in (([0], {4}), ([4], {0, 2, 6, 8})):
        env = environment_after("tictactoe", moves)
        rng = [np.random.default_rng(seed) for seed in range(80)]
        assert set(script("solver", *spaces(env)).act(observations([env] * 80), rng=rng).actions.tolist()) == best


@pytest.mark.parametrize("seed", [28, 40, 59, 102, 173, 176, 224])
def test_late_outcomes_of_connect_four_equal_those_of_minimax(seed: int) -> None:
    """The random games of these seeds have more than 36 plies."""
    for plies in (32, 34, 36):
        moves = random_moves("connect_four", seed, plies)
        assert len(moves) == plies
        env = environment_after("connect_four", moves)
        assert outcomes(CONNECT_FOUR, env) == expected_outcomes("connect_four", moves)


def test_early_positions_of_connect_four_are_played_like_one_ply() -> None:
    for plies in (0, 41 - MAX_EMPTY):
        seed = next(seed for seed in range(1000) if len(random_moves("connect_four", seed, plies)) == plies)
        env = environment_after("connect_four", random_moves("connect_four", seed, plies))
        assert len(legal(env)) > 1
        batch = observations([env] * 50)
        first, second = (
            script(name, *spaces(env))
            .act(batch, rng=[np.random.default_rng(row) for row in range(50)])
            .actions.tolist()
            for name in ("solver", "one_ply")
        )
        assert first == second
