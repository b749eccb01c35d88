"""Positions of connect four and tic-tac-toe in PettingZoo's environments."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pettingzoo.classic.connect_four.connect_four import raw_env as connect_four
from pettingzoo.classic.tictactoe.tictactoe import raw_env as tictactoe

from league.spaces import Space
from league.spaces.arrays import tensors
from league.spaces.conversion import from_gymnasium

GAMES = {"connect_four": connect_four, "tictactoe": tictactoe}


def environment_after(game: str, moves: Sequence[int]) -> Any:
    """An environment after these moves."""
    env = GAMES[game]()
    env.reset(seed=0)
    for move in moves:
        env.step(move)
    return env


def random_moves(game: str, seed: int, plies: int) -> list[int]:
    """This number of random legal moves, or fewer if the game would end."""
    random, moves = np.random.default_rng(seed), list[int]()
    env = environment_after(game, moves)
    for _ in range(plies):
        move = int(random.choice(legal(env)))
        env.step(move)
        if any(env.terminations.values()):
            break
        moves.append(move)
    return moves


def legal(env: Any) -> list[int]:
    return np.flatnonzero(env.observe(env.agent_selection)["action_mask"]).tolist()


def spaces(env: Any) -> tuple[Space, Space]:
    agent = env.possible_agents[0]
    return from_gymnasium(env.observation_space(agent)), from_gymnasium(env.action_space(agent))


def observations(envs: Sequence[Any]) -> dict[str, np.ndarray]:
    """The batch of what the agents to act observe."""
    values = {id(env): tensors(spaces(env)[0], env.observe(env.agent_selection)) for env in envs}
    return {name: np.stack([values[id(env)][name] for env in envs]) for name in values[id(envs[0])]}
