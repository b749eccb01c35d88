"""Board games in which two players place pieces alternately until one completes a line or the board is full."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.alternation import TurnRows, rows_after_move
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.errors import ObservationError
from league.spaces import ACTION_MASK, OBSERVATION


class BoardGame(VectorEnv):
    """The part that such games share: turns, observations, masks, endings and rewards.

    An observation has two planes, the agent's own pieces and those of the opponent, (rows, columns, 2) int8. Both
    observations of a copy are kept, and a move changes one number in each. The winner gets 1 and the loser -1.
    """

    def __init__(self, num_envs: int, shape: tuple[int, int], num_actions: int) -> None:
        self.num_envs = num_envs
        self._shape, self._cells = (*shape, 2), shape[0] * shape[1]
        self._planes = np.zeros((num_envs, 2, self._cells * 2), dtype=np.int8)
        self._masks = np.ones((num_envs, num_actions), dtype=np.int8)
        self._moves = np.zeros(num_envs, dtype=np.int64)

    def reset(self, env_ids: NDArray[np.int64], seeds: NDArray[np.int64]) -> Sequence[AgentRows]:
        del seeds  # nothing is random
        self._planes[env_ids] = 0
        self._masks[env_ids] = 1
        self._moves[env_ids] = 0
        self._clear(env_ids)
        rows = len(env_ids)
        return self._reports(
            TurnRows(env_ids, np.zeros(rows, dtype=np.int64), np.zeros(rows), np.zeros(rows, dtype=bool))
        )

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        moves = self._moves.take(env_ids)
        mover = moves & 1
        self._moves[env_ids] = moves + 1
        player = 2 * env_ids + mover
        cell, won = self._place(env_ids, player, np.asarray(actions, dtype=np.int64))
        # 2 · copy + player ^ 1 is the opponent's row.
        planes = self._rows()
        planes[player, 2 * cell] = 1
        planes[player ^ 1, 2 * cell + 1] = 1
        over = won | (moves == self._cells - 1)
        return self._reports(rows_after_move(env_ids, mover, over, won))

    def restore(self, env_ids: NDArray[np.int64], observations: Mapping[str, NDArray[Any]]) -> Sequence[AgentRows]:
        """See VectorEnv. The first player acts if both have as many pieces, the second if it has one less."""
        boards = observations[OBSERVATION].reshape(len(env_ids), self._cells, 2) != 0
        pieces = boards.sum(axis=1)
        agents = pieces[:, 1] - pieces[:, 0]
        is_wrong = (agents < 0) | (agents > 1) | boards.all(axis=2).any(axis=1) | (pieces.sum(axis=1) == self._cells)
        is_wrong |= self._put(env_ids, np.where(agents[:, np.newaxis, np.newaxis] == 1, boards[..., ::-1], boards))
        if is_wrong.any():
            row = int(is_wrong.argmax())
            raise ObservationError(
                f"observation {row} is not a position in which a player must move: {pieces[row, 0]} own pieces and"
                f" {pieces[row, 1]} of the opponent"
            )
        self._moves[env_ids] = pieces.sum(axis=1)
        self._planes[env_ids, agents] = boards.reshape(-1, 2 * self._cells)
        self._planes[env_ids, 1 - agents] = boards[..., ::-1].reshape(-1, 2 * self._cells)
        return self._reports(TurnRows(env_ids, agents, np.zeros(len(agents)), np.zeros(len(agents), dtype=bool)))

    @abstractmethod
    def _put(self, env_ids: NDArray[np.int64], boards: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Replace all pieces, and update the masks.

        Args:
            env_ids: Copies, (m,).
            boards: Pieces of the first and of the second player, (m, cells, 2), row by row from the top left.

        Returns:
            Whether each board cannot occur, or a player has won, (m,).
        """

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
            OBSERVATION: self._rows().take(2 * rows.envs + rows.agents, axis=0).reshape(-1, *self._shape),
            ACTION_MASK: self._masks.take(rows.envs, axis=0),
        }
        return (AgentRows(rows.envs, rows.agents, observations, *rows[2:], np.zeros(len(rows.envs), dtype=bool)),)

    def _rows(self) -> NDArray[np.int8]:
        """The observations, two rows for each copy: 2 · copy + player."""
        return self._planes.reshape(-1, 2 * self._cells)
