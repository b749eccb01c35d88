"""Board games in which two players place pieces alternately until one completes a line or the board is full."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.alternation import TurnRows, rows_after_move
from league.environments.vector.vector_env import AgentRows, VectorEnv


class BoardGame(VectorEnv):
    """The part that such games share: turns, observations, masks, endings and rewards.

    An observation has two planes, the agent's own pieces and those of the opponent, (rows, columns, 2) int8. Both
    observations of a copy are kept, and a move changes one number in each. The winner gets 1 and the loser -1.
    """

    def __init__(self, num_envs: int, shape: tuple[int, int], num_actions: int) -> None:
        self.num_envs = num_envs
        self._shape, self._cells = (*shape, 2), shape[0] * shape[1]
        # Two rows for each copy, one for each player: 2 · copy + player.
        self._planes = np.zeros((num_envs * 2, self._cells * 2), dtype=np.int8)
        self._masks = np.ones((num_envs, num_actions), dtype=np.int8)
        self._moves = np.zeros(num_envs, dtype=np.int64)

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        del seeds  # nothing is random
        self._planes[2 * env_ids] = 0
        self._planes[2 * env_ids + 1] = 0
        self._masks[env_ids] = 1
        self._moves[env_ids] = 0
        self._clear(env_ids)
        rows = len(env_ids)
        return self._reports(
            TurnRows(env_ids, np.zeros(rows, dtype=np.int64), np.zeros(rows), np.zeros(rows, dtype=bool))
        )

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        moves = self._moves[env_ids]
        mover = moves & 1
        self._moves[env_ids] = moves + 1
        player = 2 * env_ids + mover
        cell, won = self._place(env_ids, player, np.asarray(actions, dtype=np.int64))
        # 2 · copy + player ^ 1 is the opponent's row.
        self._planes[player, 2 * cell] = 1
        self._planes[player ^ 1, 2 * cell + 1] = 1
        over = won | (moves == self._cells - 1)
        return self._reports(rows_after_move(env_ids, mover, over, won))

    @abstractmethod
    def _place(
        self, env_ids: NDArray[np.int64], players: NDArray[np.int64], actions: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Place a piece in each copy, and update the masks.

        Args:
            env_ids: Copies, (m,).
            players: 2 · copy + player, (m,).
            actions: (m,).

        Returns:
            The cells, (m,), row by row from the top left of the observation, and whether the player has won, (m,).
        """

    @abstractmethod
    def _clear(self, env_ids: NDArray[np.int64]) -> None:
        """Remove all pieces."""

    def _reports(self, rows: TurnRows) -> tuple[AgentRows]:
        observations = {
            "observation": self._planes.take(2 * rows.envs + rows.agents, axis=0).reshape(-1, *self._shape),
            "action_mask": self._masks.take(rows.envs, axis=0),
        }
        return (AgentRows(rows.envs, rows.agents, observations, *rows[2:], np.zeros(len(rows.envs), dtype=bool)),)
