"""Monte Carlo tree search on positions of the real games."""

import sys

import numpy as np
import pytest

from league.errors import ConfigError, ObservationError
from league.policies.scripted import script
from tests.support.environments.line_games import environment_after, observations, random_moves, spaces


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
