"""Depth-limited minimax search on batches of positions: the scripts `one_ply`, `minimax_2` and `minimax_4`.

All positions of a batch are searched at once with bitboards, so a teacher of this kind costs a fraction of training.
"""

import numpy as np
from numpy.typing import NDArray

from league.policies.line_games.game import BestMoves, LineGame, line_game
from league.spaces import Space

Bitboards = NDArray[np.uint64]
LOST = -128
"""Below each value of a position."""


class BatchedMinimax:
    """Computes the values of moves. A position is a pair of bitboards: of the player to move and of its opponent."""

    def __init__(self, game: LineGame) -> None:
        self._game = game
        self._bits = game.bits()
        squares = self._bits.reshape(game.rows, game.columns)
        self._board = np.bitwise_or.reduce(self._bits)
        self._lowest = np.bitwise_or.reduce(squares[-1])
        self.reached = np.bitwise_or.reduce(squares, axis=0) if game.gravity else self._bits

    def positions(self, boards: NDArray) -> tuple[Bitboards, Bitboards]:
        """Return the bitboards of boards (k, rows, columns, 2), two (k,) uint64."""
        own_bitboards, other_bitboards = (
            (boards[..., player].reshape(-1, len(self._bits)) != 0).astype(np.uint64) @ self._bits for player in (0, 1)
        )
        return own_bitboards, other_bitboards

    def values(self, own: Bitboards, other: Bitboards, plies: int) -> NDArray[np.int8]:
        """Return the value of each move, if the rest of the search is played best.

        Args:
            own: Pieces of the player to move, (k,). No line is complete.
            other: Pieces of the opponent, (k,).
            plies: Number of moves to look ahead, at least 1.

        Returns:
            (k, actions): `plies` − d if the player wins with its d-th ply from here (0, 2, …), −(`plies` − d) if the
            opponent does (1, 3, …), 0 if neither, and LOST for an illegal move.
        """
        values = np.full((len(own), self._game.actions), LOST, np.int8)
        winning, moves = self.completing(own), self.moves(own | other)
        safe = self._safe(moves, other) & ~winning
        for action, squares in enumerate(self.reached):
            move = moves & squares
            values[move != 0, action] = 1 - plies
            values[(winning & move) != 0, action] = plies
            rows = np.flatnonzero(safe & move)
            values[rows, action] = -self._value(other[rows], (own | move)[rows], plies - 1)
        return values

    def _value(self, own: Bitboards, other: Bitboards, plies: int) -> NDArray[np.int8]:
        """Return the values of positions, (k,), in which no move wins: `values` of the best moves; 0 without moves."""
        if plies < 2:
            return np.zeros(len(own), np.int8)
        moves = self.moves(own | other)
        safe = self._safe(moves, other)
        best = np.where((safe == 0) & (moves != 0), 1 - plies, 0).astype(np.int8)
        if plies == 2:
            return best
        best[safe != 0] = LOST
        for squares in self.reached:
            move = safe & squares
            rows = np.flatnonzero(move)
            if len(rows):
                replies = -self._value(other[rows], (own | move)[rows], plies - 1)
                best[rows] = np.maximum(best[rows], replies)
        return best

    def moves(self, taken: Bitboards) -> Bitboards:
        """Return the squares that can be taken: the empty ones, with gravity the lowest empty one of each column."""
        return (taken + self._lowest) & self._board if self._game.gravity else self._board & ~taken

    def _safe(self, moves: Bitboards, opponents: Bitboards) -> Bitboards:
        """Return the moves after which the opponent cannot win at once."""
        winning = self.completing(opponents) & self._board
        threats = moves & winning
        # One threat must be prevented; of several, one remains.
        safe = np.where(threats == 0, moves, threats)
        safe[threats & (threats - np.uint64(1)) != 0] = 0
        # With gravity, a move lets the opponent take the square above.
        return safe & ~(winning >> np.uint64(1)) if self._game.gravity else safe

    def completing(self, pieces: Bitboards) -> Bitboards:
        """Return the squares that complete a line of `pieces`, occupied ones and ones outside the board included."""
        squares = np.zeros_like(pieces)
        everywhere = ~squares
        for step in self._game.steps():
            # Squares with at least this number of pieces in a row on one side and on the other.
            above, below = [everywhere], [everywhere]
            for distance in range(1, self._game.length):
                bits = np.uint64(distance * step)
                above.append(above[-1] & (pieces >> bits))
                below.append(below[-1] & (pieces << bits))
            for count in range(self._game.length):
                squares |= above[count] & below[-1 - count]
        return squares


class OnePly(BestMoves):
    """Wins immediately if possible, else prevents the opponent's immediate win, else plays like `random`."""

    def __init__(self, observation: Space, action: Space) -> None:
        self._search = BatchedMinimax(line_game("one_ply", observation, action))

    def best(self, boards: NDArray, legal: NDArray) -> NDArray:
        players = self._search.positions(boards)
        moves, best = self._search.moves(players[0] | players[1]), legal
        for pieces in reversed(players):
            completing = (self._search.completing(pieces) & moves)[:, np.newaxis] & self._search.reached != 0
            best = np.where((legal & completing).any(axis=1, keepdims=True), legal & completing, best)
        return best


class Minimax(BestMoves):
    """Plays a random one of the moves that are best within `plies` moves, in connect four and tic-tac-toe."""

    def __init__(self, plies: int, observation: Space, action: Space) -> None:
        self._search = BatchedMinimax(line_game(f"minimax_{plies}", observation, action))
        self._plies = plies

    def best(self, boards: NDArray, legal: NDArray) -> NDArray:
        values = np.where(legal, self._search.values(*self._search.positions(boards), self._plies), LOST)
        return legal & (values == values.max(axis=1, keepdims=True))
