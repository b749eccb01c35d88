"""Vectorised tic-tac-toe, equal to pettingzoo.classic.tictactoe_v3."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.board_game import BoardGame
from league.environments.vector.vector_env import UnsupportedArguments

LINES = ((0, 1, 2), (3, 4, 5), (6, 7, 8), (0, 3, 6), (1, 4, 7), (2, 5, 8), (0, 4, 8), (2, 4, 6))
IS_WIN = np.array([any(all(pieces >> cell & 1 for cell in line) for line in LINES) for pieces in range(2**9)])
"""Whether a player with these pieces has a line, (512,) bool. Bit i of the index is cell i."""


class TicTacToe(BoardGame):
    """Copies of tic-tac-toe. The action is the cell."""

    possible_agents = ("player_1", "player_2")

    def __init__(self, num_envs: int, **kwargs: Any) -> None:
        if kwargs:
            raise UnsupportedArguments(f"tic-tac-toe is not vectorised with {', '.join(kwargs)}")
        super().__init__(num_envs, (3, 3), 9)
        self._boards = np.zeros((num_envs, 2), dtype=np.int64)

    def _place(
        self, env_ids: NDArray[np.int64], players: NDArray[np.int64], actions: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        self._masks.reshape(-1)[env_ids * 9 + actions] = 0
        boards = self._boards.reshape(-1)
        pieces = boards[players] | (1 << actions)
        boards[players] = pieces
        return actions, IS_WIN[pieces]

    def _put(self, env_ids: NDArray[np.int64], boards: NDArray[np.bool_]) -> NDArray[np.bool_]:
        pieces = (boards << np.arange(9)[:, np.newaxis]).sum(axis=1)
        self._boards[env_ids], self._masks[env_ids] = pieces, ~boards.any(axis=2)
        return IS_WIN[pieces].any(axis=1)

    def _clear(self, env_ids: NDArray[np.int64]) -> None:
        self._boards[env_ids] = 0
