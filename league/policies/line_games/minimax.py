"""Depth-limited minimax search on batches of positions: the scripts `minimax_2` and `minimax_4`.

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
        self._columns = np.bitwise_or.reduce(squares, axis=0)
        self._lowest = squares[-1]
        self._reached = self._columns if game.gravity else self._bits

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
        winning, moves = self._completing(own), self._moves(own | other)
        for action in range(self._game.actions):
            move = moves & self._reached[action]
            wins = (winning & move) != 0
            values[wins, action] = plies
            rows = np.flatnonzero((move != 0) & ~wins)
            values[rows, action] = -self._value(other[rows], (own | move)[rows], plies - 1) if plies > 1 else 0
        return values

    def _value(self, own: Bitboards, other: Bitboards, plies: int) -> NDArray[np.int8]:
        """Return the values of positions, (k,): `values` of the best moves, or 0 if the board is full."""
        moves = self._moves(own | other)
        wins = (self._completing(own) & moves) != 0
        value = np.where(wins, plies, 0).astype(np.int8)
        rows = np.flatnonzero(~wins & (moves != 0))
        if plies == 1 or not len(rows):
            return value
        players, opponents = own[rows], other[rows]
        # Only a move that prevents the opponent's immediate win can be better than losing at once.
        threats = self._completing(opponents) & moves[rows]
        candidates = np.where(threats != 0, threats, moves[rows])
        best = np.full(len(rows), LOST, np.int8)
        for squares in self._reached:
            move = candidates & squares
            moving = np.flatnonzero(move)
            replies = -self._value(opponents[moving], (players | move)[moving], plies - 1)
            best[moving] = np.maximum(best[moving], replies)
        value[rows] = best
        return value

    def _moves(self, taken: Bitboards) -> Bitboards:
        """Return the squares that can be taken: the empty ones, with gravity the lowest empty one of each column."""
        squares = np.bitwise_or.reduce(self._bits)
        return (taken + np.bitwise_or.reduce(self._lowest)) & squares if self._game.gravity else squares & ~taken

    def _completing(self, pieces: Bitboards) -> Bitboards:
        """Return the squares that complete a line of `pieces`, occupied ones and ones outside the board included."""
        squares = np.zeros_like(pieces)
        for step in self._game.steps():
            for gap in range(self._game.length):
                line = ~np.zeros_like(pieces)
                for distance in range(self._game.length):
                    if distance != gap:
                        bits = (gap - distance) * step
                        line &= pieces << np.uint64(bits) if bits >= 0 else pieces >> np.uint64(-bits)
                squares |= line
        return squares


class Minimax(BestMoves):
    """Plays a random one of the moves that are best within `plies` moves, in connect four and tic-tac-toe."""

    def __init__(self, plies: int, observation: Space, action: Space) -> None:
        self._search = BatchedMinimax(line_game(f"minimax_{plies}", observation, action))
        self._plies = plies

    def best(self, boards: NDArray, legal: NDArray) -> NDArray:
        values = np.where(legal, self._search.values(*self._search.positions(boards), self._plies), LOST)
        return legal & (values == values.max(axis=1, keepdims=True))
