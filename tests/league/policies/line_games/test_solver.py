"""The solver, compared with OpenSpiel's alpha-beta search on positions of the real games."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyspiel
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from open_spiel.python.algorithms.minimax import alpha_beta_search

from league.policies.line_games.game import CONNECT_FOUR, TIC_TAC_TOE, LineGame
from league.policies.line_games.solver import MAX_EMPTY, LineGameSolver
from league.policies.scripted import script
from tests.support.environments.line_games import environment_after, legal, observations, random_moves, spaces


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


@settings(max_examples=40, deadline=None)
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
