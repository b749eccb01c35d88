"""Exact play by search with bitboards: the script `solver` for tic-tac-toe and late positions of connect four."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from league.policies.line_games.game import BestMoves, LineGame, line_game
from league.policies.line_games.minimax import OnePly
from league.spaces import Space

MAX_EMPTY = 18
"""Number of empty squares up to which positions are solved."""
CACHED_POSITIONS = 2**18


class LineGameSolver:
    """Computes the outcomes of moves. A position is a pair of bitboards: of the player to move and of its opponent."""

    def __init__(self, game: LineGame) -> None:
        self._game, self._stride = game, game.rows + 1
        self._bits = game.bits()
        self._full = int(self._bits.sum())
        actions = range(game.actions)
        self._order = (
            sorted(actions, key=lambda column: abs(2 * column + 1 - game.columns)) if game.gravity else actions
        )
        self._reaches = lru_cache(maxsize=CACHED_POSITIONS)(self._search)

    def position(self, board: NDArray) -> tuple[int, int]:
        """Return the bitboards of a board (rows, columns, 2)."""
        own_bitboard, other_bitboard = (
            self._bits @ (board[..., player].ravel() != 0).astype(np.uint64) for player in (0, 1)
        )
        return int(own_bitboard), int(other_bitboard)

    def outcomes(self, own: int, other: int) -> dict[int, int]:
        """Return each legal action with its outcome under best play: 1 for a win, 0 for a draw, −1 for a loss."""
        return {
            action: 1 if self._wins(own | move) else -self._outcome(other, own | move)
            for action, move in self._moves(own | other)
        }

    def _outcome(self, own: int, other: int) -> int:
        return 1 if self._reaches(own, other, 1) else 0 if self._reaches(own, other, 0) else -1

    def _search(self, own: int, other: int, goal: int) -> bool:
        """Return whether the player to move can reach a draw (0) or a win (1). No line is complete."""
        moves = [move for _, move in self._moves(own | other)]
        if not moves:
            return goal == 0
        if any(self._wins(own | move) for move in moves):
            return True
        threats = [move for move in moves if self._wins(other | move)]
        return any(not self._reaches(other, own | move, 1 - goal) for move in threats or moves)

    def _moves(self, taken: int) -> Iterator[tuple[int, int]]:
        """Yield the legal actions and the squares that they take."""
        for action in self._order:
            if self._game.gravity:
                lowest = 1 << action * self._stride
                move = (taken + lowest) & self._full & (lowest * ((1 << self._stride) - 1))
            else:
                move = int(self._bits[action]) & ~taken
            if move:
                yield action, move

    def _wins(self, pieces: int) -> bool:
        """Return whether `pieces` contain a line."""
        for step in self._game.steps():
            line = pieces
            for distance in range(1, self._game.length):
                line &= pieces >> distance * step
            if line:
                return True
        return False


class Solver(BestMoves):
    """Plays a random one of the best actions if at most MAX_EMPTY squares are empty, else like `one_ply`."""

    def __init__(self, observation: Space, action: Space) -> None:
        self._solver = LineGameSolver(line_game("solver", observation, action))
        self._early = OnePly(observation, action)

    def best(self, boards: NDArray, legal: NDArray) -> NDArray:
        best = self._early.best(boards, legal)
        for row in np.flatnonzero((boards.sum(axis=3) == 0).sum(axis=(1, 2)) <= MAX_EMPTY):
            outcomes = self._solver.outcomes(*self._solver.position(boards[row]))
            values = np.array([outcomes.get(action, -2) for action in range(legal.shape[1])])
            best[row] = legal[row] & (values == values[legal[row]].max())
        return best
