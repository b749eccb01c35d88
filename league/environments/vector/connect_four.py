"""Vectorised connect four, equal to pettingzoo.classic.connect_four_v3."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.board_game import BoardGame
from league.environments.vector.vector_env import UnsupportedArguments

ROWS, COLUMNS = 6, 7
# In a bitboard a column has seven bits, from the bottom to the top. The seventh is always 0, so that lines do not
# continue from the top of a column at the bottom of the next one.
STRIDE = ROWS + 1
DIRECTIONS = np.array([1, STRIDE - 1, STRIDE, STRIDE + 1], dtype=np.uint64)[:, np.newaxis]
"""Distances between neighbouring bits of a vertical line, of both diagonals and of a horizontal line, (4, 1)."""
TWICE = 2 * DIRECTIONS
"""From a pair of pieces to the other pair of a line of four."""

BITS = np.left_shift(np.uint64(1), np.arange(COLUMNS * STRIDE, dtype=np.uint64)).reshape(COLUMNS, STRIDE).T[:ROWS]
BITS = BITS[..., np.newaxis]
"""Bit of each cell, from the bottom row, (6, 7, 1)."""


class ConnectFour(BoardGame):
    """Copies of connect four. Each player's pieces are a bitboard."""

    possible_agents = ("player_0", "player_1")

    def __init__(self, num_envs: int, **kwargs: Any) -> None:
        if kwargs:
            raise UnsupportedArguments(f"connect four is not vectorised with {', '.join(kwargs)}")
        super().__init__(num_envs, (ROWS, COLUMNS), COLUMNS)
        self._boards = np.zeros((num_envs, 2), dtype=np.uint64)
        self._heights = np.zeros((num_envs, COLUMNS), dtype=np.int64)

    def _place(
        self, env_ids: NDArray[np.int64], players: NDArray[np.int64], actions: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        column = env_ids * COLUMNS + actions
        heights, boards = self._heights.reshape(-1), self._boards.reshape(-1)
        height = heights.take(column)
        heights[column] = height + 1
        self._masks.reshape(-1)[column] = height < ROWS - 1
        pieces = boards.take(players) | BITS.take(actions + height * COLUMNS)
        boards[players] = pieces
        return (ROWS - 1 - height) * COLUMNS + actions, has_four(pieces)

    def _put(self, env_ids: NDArray[np.int64], boards: NDArray[np.bool_]) -> NDArray[np.bool_]:
        # (m, rows from the bottom, columns, 2)
        boards = boards.reshape(-1, ROWS, COLUMNS, 2)[:, ::-1]
        is_occupied = boards.any(axis=3)
        heights = is_occupied.sum(axis=1)
        bitboards = (boards * BITS).sum(axis=(1, 2), dtype=np.uint64)
        self._heights[env_ids], self._masks[env_ids], self._boards[env_ids] = heights, heights < ROWS, bitboards
        hovers = (is_occupied != (np.arange(ROWS)[:, np.newaxis] < heights[:, np.newaxis])).any(axis=(1, 2))
        return hovers | has_four(bitboards.ravel()).reshape(-1, 2).any(axis=1)

    def _clear(self, env_ids: NDArray[np.int64]) -> None:
        self._boards[env_ids] = 0
        self._heights[env_ids] = 0


def has_four(boards: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which bitboards (m,) have four pieces in a line."""
    pairs = boards & (boards >> DIRECTIONS)
    return (pairs & (pairs >> TWICE)).any(axis=0)
