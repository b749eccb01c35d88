"""Connect four and tic-tac-toe as line games, and the script `one_ply`, which plays both.

`one_ply` wins immediately if possible, else prevents the opponent's immediate win, else plays like `random`.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from league.errors import EnvironmentMismatch
from league.policies.actions import check_legal_action
from league.policies.draws import Generators, choose, draw
from league.policies.policy import Actions, Arrays
from league.spaces import ACTION_MASK, OBSERVATION, Discrete, Space, inputs


@dataclass(frozen=True, slots=True)
class LineGame:
    """A game won by `length` squares in a line. Observations have two planes: own and opponent's squares.

    With `gravity` an action is a column, whose lowest empty square is taken (row 0 is the top); otherwise it is a
    square, numbered row by row.
    """

    rows: int
    columns: int
    length: int
    gravity: bool

    @property
    def actions(self) -> int:
        return self.columns if self.gravity else self.rows * self.columns

    def lines(self) -> NDArray:
        """Return the squares of each line as 0 and 1, (lines, rows · columns) float32."""
        covered = []
        for row, column in product(range(self.rows), range(self.columns)):
            for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
                last_row, last_column = row + down * (self.length - 1), column + right * (self.length - 1)
                if last_row < self.rows and 0 <= last_column < self.columns:
                    line = np.zeros((self.rows, self.columns), np.float32)
                    for step in range(self.length):
                        line[row + down * step, column + right * step] = 1
                    covered.append(line.ravel())
        return np.array(covered)

    def bits(self) -> NDArray[np.uint64]:
        """Return the bit of each square in a bitboard, (rows · columns,).

        A column has one bit per square, from the bottom to the top, and one that is always 0, so that lines do not
        continue in the next column.
        """
        positions = [
            column * (self.rows + 1) + row for row in reversed(range(self.rows)) for column in range(self.columns)
        ]
        return np.uint64(1) << np.array(positions, np.uint64)

    def steps(self) -> tuple[int, ...]:
        """Return the distances between neighbouring bits of a line: up, and the three directions to the right."""
        return 1, self.rows, self.rows + 1, self.rows + 2

    def actions_on(self, squares: NDArray, empty: NDArray) -> NDArray:
        """Return which actions take one of `squares`: two (k, rows · columns) bool → (k, actions) bool."""
        if not self.gravity:
            return squares & empty
        empty = empty.reshape(-1, self.rows, self.columns)
        lowest = empty.copy()
        lowest[:, :-1] &= ~empty[:, 1:]
        return (squares.reshape(empty.shape) & lowest).any(axis=1)


CONNECT_FOUR = LineGame(rows=6, columns=7, length=4, gravity=True)
TIC_TAC_TOE = LineGame(rows=3, columns=3, length=3, gravity=False)


def line_game(name: str, observation: Space, action: Space) -> LineGame:
    """Return the game with these spaces. Raises EnvironmentMismatch, which names the script, if there is none."""
    leaves = inputs(observation)
    for game in (CONNECT_FOUR, TIC_TAC_TOE):
        fits = OBSERVATION in leaves and leaves[OBSERVATION].shape == (game.rows, game.columns, 2)
        if fits and ACTION_MASK in leaves and action == Discrete(n=game.actions):
            return game
    raise EnvironmentMismatch(f"script:{name} needs the spaces of PettingZoo's connect_four_v3 or tictactoe_v3")


class BestMoves(ABC):
    """A script that plays a random one of the moves that it considers best."""

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,  # noqa: ARG002
        explore: bool = False,  # noqa: ARG002
        rng: Generators | None = None,
    ) -> Actions:
        """Choose actions for a batch; see `Policy.act`. Raises IllegalMask if a row allows no action."""
        legal = observations[ACTION_MASK] != 0
        check_legal_action(legal)
        best = self.best(observations[OBSERVATION], legal)
        return Actions(choose(best, draw(rng, len(best))))

    @abstractmethod
    def best(self, boards: NDArray, legal: NDArray) -> NDArray:
        """Return the actions that it chooses from: (k, rows, columns, 2) and (k, actions) bool → (k, actions) bool."""


class OnePly(BestMoves):
    """Looks one move ahead in connect four and tic-tac-toe."""

    def __init__(self, observation: Space, action: Space) -> None:
        self._game = line_game("one_ply", observation, action)
        self._lines = self._game.lines()

    def best(self, boards: NDArray, legal: NDArray) -> NDArray:
        planes = boards.reshape(len(boards), -1, 2).astype(np.float32)
        empty = planes.sum(axis=2) == 0
        best = legal
        for player in (1, 0):
            completing = legal & self._game.actions_on(self._completing(planes[:, :, player]), empty)
            best = np.where(completing.any(axis=1, keepdims=True), completing, best)
        return best

    def _completing(self, own: NDArray) -> NDArray:
        """Return the squares of all lines in which one square is missing in `own`, (k, squares)."""
        almost = own @ self._lines.T == self._game.length - 1
        return almost.astype(np.float32) @ self._lines > 0
