"""Connect four and tic-tac-toe as line games, and the base of the scripts that play both."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.errors import EnvironmentMismatch
from league.policies.draws import Generators, choose, draw
from league.policies.policy import Actions, Arrays
from league.spaces import ACTION_MASK, OBSERVATION, Discrete, Space, inputs
from league.spaces.arrays import check_legal_action


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
