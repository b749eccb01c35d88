"""Monte Carlo tree search with OpenSpiel: the scripts `mcts_100` and `mcts_1000` for connect four and tic-tac-toe.

Both search from the observed board with `pyspiel.MCTSBot`: UCT with one random playout per simulation (Kocsis and
Szepesvári, 2006, "Bandit based Monte-Carlo planning") and proven values of positions (Winands et al., 2008,
"Monte-Carlo tree search solver").
"""

import json

import numpy as np
from numpy.typing import NDArray

from league.errors import ConfigError, ObservationError
from league.policies.draws import Generators, draw
from league.policies.line_games.game import CONNECT_FOUR, TIC_TAC_TOE, LineGame, line_game
from league.policies.policy import Actions, Arrays
from league.spaces import ACTION_MASK, OBSERVATION, Space
from league.spaces.arrays import check_legal_action

NAMES = {CONNECT_FOUR: "connect_four", TIC_TAC_TOE: "tic_tac_toe"}
"""The games' names in OpenSpiel."""
EXPLORATION = 2.0
"""UCT's constant; OpenSpiel's default."""
MEMORY_MB = 100


class MCTS:
    """Searches with a number of simulations per move. The search is seeded from the row's generator."""

    def __init__(self, simulations: int, observation: Space, action: Space) -> None:
        """Raises ConfigError if OpenSpiel is not installed."""
        self._game = line_game(f"mcts_{simulations}", observation, action)
        try:
            import pyspiel
        except ImportError:
            raise ConfigError(
                f"script:mcts_{simulations} needs OpenSpiel: pip install 'policy-league[openspiel]'"
            ) from None
        self._pyspiel = pyspiel
        self._rules = pyspiel.load_game(NAMES[self._game])
        self._simulations = simulations

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,  # noqa: ARG002
        explore: bool = False,  # noqa: ARG002
        rng: Generators | None = None,
    ) -> Actions:
        """Choose actions for a batch; see `Policy.act`.

        Raises:
            IllegalMask: A row allows no action.
            ObservationError: An observation is not a position of the game.
        """
        boards = observations[OBSERVATION]
        check_legal_action(observations[ACTION_MASK])
        seeds = (draw(rng, len(boards)) * 2**31).astype(np.int64)
        return Actions(np.array([self._search(*row) for row in zip(boards, seeds.tolist(), strict=True)], np.int64))

    def _search(self, board: NDArray, seed: int) -> int:
        playouts = self._pyspiel.RandomRolloutEvaluator(1, seed)
        bot = self._pyspiel.MCTSBot(self._rules, playouts, EXPLORATION, self._simulations, MEMORY_MB, True, seed, False)
        return int(bot.step(self._rules.new_initial_state(_position(self._game, board))))


def _position(game: LineGame, board: NDArray) -> str:
    """Return OpenSpiel's JSON for a board (rows, columns, 2) of the player to act."""
    own_count, other_count = (int(board[..., player].sum()) for player in (0, 1))
    if other_count - own_count not in (0, 1) or board.sum(axis=2).max() > 1:
        raise ObservationError(
            f"observation is not a position of {NAMES[game]}: {own_count} own pieces and {other_count} of the opponent"
        )
    marks = ("x", "o") if own_count == other_count else ("o", "x")
    squares = np.where(board[..., 0] != 0, marks[0], np.where(board[..., 1] != 0, marks[1], "."))
    position = {"current_player": marks[0], "is_terminal": False, "winner": ""}
    # OpenSpiel lists the rows of connect four from the bottom.
    return json.dumps(position | {"board": (squares[::-1] if game.gravity else squares.ravel()).tolist()})
