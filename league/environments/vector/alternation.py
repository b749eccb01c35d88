"""Rows of games in which two players take turns and one wins what the other loses."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class TurnRows(NamedTuple):
    """Columns of AgentRows, (k,)."""

    envs: NDArray[np.int64]
    agents: NDArray[np.int64]
    rewards: NDArray[np.float64]
    terminations: NDArray[np.bool_]


def rows_after_move(
    env_ids: NDArray[np.int64], movers: NDArray[np.int64], over: NDArray[np.bool_], gains: NDArray
) -> TurnRows:
    """Return the rows after one player of each copy has moved.

    A game that goes on has one row, of the other player. A game that is over has two, in the order of PettingZoo's
    dead steps: the other player, then the mover.

    Args:
        env_ids: Copies, (m,), ascending.
        movers: Who has moved, 0 or 1, (m,).
        over: Whether the game is over, (m,).
        gains: What the mover wins if the game is over, (m,).
    """
    if not np.count_nonzero(over):
        return TurnRows(env_ids, movers ^ 1, np.zeros(len(env_ids)), np.zeros(len(env_ids), dtype=bool))
    count = 1 + over
    envs, agents = np.repeat(env_ids, count), np.repeat(movers ^ 1, count)
    rewards, terminations = np.zeros(len(envs)), np.zeros(len(envs), dtype=bool)
    ended = np.flatnonzero(over)
    second = ended + np.arange(1, len(ended) + 1)
    agents[second] ^= 1
    rewards[second] = gains[ended]
    rewards[second - 1] = 0.0 - gains[ended]  # a negated zero would be -0.0
    terminations[second] = terminations[second - 1] = True
    return TurnRows(envs, agents, rewards, terminations)
