"""Scores the learner's games against its opponents by the rule of the league's matches.

`league.results.scoring` defines the rule. If sides are symmetric, the learner's return is compared with the opponent's
in each game. The opponent has all other sides: if there are several, the score is the mean over them, so that equal
policies score ½ on average, as in the two games of a block. If sides are not symmetric, two games with the learner on
either side form a block, and returns on the same side are compared; a game waits for its partner until the episodes are
reset. Unlike those of a match, the games of such a block have different seeds. If there are more than two such sides,
games are not scored: the learner never has all sides but one.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Indices, Turn
from league.results.records import Scoring

MOST_WAITING = 16
"""Games against an opponent, with the learner on one side, that wait for a partner: the newest ones."""
NO_ROWS = np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True)
class OpponentResults:
    """Episodes, scored games and the sum of the learner's scores in them, for each opponent, (opponents,).

    A game may be scored later than its episode is counted, or never.
    """

    episodes: NDArray[np.int64]
    games: NDArray[np.int64]
    scores: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OpposedGames:
    """m finished games: the opponent's number, the learner's side and its return, each (m,), and the returns of the
    opponent's sides, (m, others).
    """

    opponents: Indices
    sides: Indices
    own: NDArray[np.float64]
    other: NDArray[np.float64]

    def __getitem__(self, rows: Indices) -> "OpposedGames":
        return OpposedGames(self.opponents[rows], self.sides[rows], self.own[rows], self.other[rows])

    def blocks(self) -> tuple["OpposedGames", "OpposedGames"]:
        """Return the games that form blocks, each with the opponent's return from its partner, and those that wait."""
        games, partners, waiting = [NO_ROWS], [NO_ROWS], [NO_ROWS]
        for opponent in np.unique(self.opponents).tolist():
            first, second = (np.flatnonzero((self.opponents == opponent) & (self.sides == side)) for side in (0, 1))
            count = min(len(first), len(second))
            games += [first[:count], second[:count]]
            partners += [second[:count], first[:count]]
            waiting += [first[count:][-MOST_WAITING:], second[count:][-MOST_WAITING:]]
        whole, partner_returns = self[np.concatenate(games)], self.other[np.concatenate(partners)]
        return replace(whole, other=partner_returns), self[np.concatenate(waiting)]

    def scores(self) -> NDArray[np.float64]:
        """Return the learner's score in each game, (m,)."""
        own_returns = self.own[:, np.newaxis]
        return np.where(own_returns > self.other, 1.0, np.where(own_returns == self.other, 0.5, 0.0)).mean(axis=1)


def is_scored(scoring: Scoring, sides: int) -> bool:
    """Return whether training games of a league with this number of sides can be scored."""
    return scoring == "game" or (scoring == "side" and sides == 2)


class OpponentScores:
    """Collects the returns of all agents in episodes with opponents."""

    def __init__(self, sides: NDArray[np.bool_], scoring: Scoring, num_envs: int) -> None:
        """sides: which agents belong to each side, (sides, agents)."""
        self._members = [np.flatnonzero(members) for members in sides]
        self._scoring, self._is_scored = scoring, is_scored(scoring, len(sides))
        self._returns = np.zeros((num_envs, sides.shape[1]))
        self.opponents = np.full(num_envs, -1)
        """The opponent's number in each environment, -1 in self-play."""
        self._sides = np.zeros(num_envs, np.int64)
        self._next_opponents, self._next_sides = self.opponents.copy(), self._sides.copy()
        self._episodes: list[Indices] = []
        self._no_games = OpposedGames(NO_ROWS, NO_ROWS, np.zeros(0), np.zeros((0, max(len(sides) - 1, 1))))
        self._finished = [self._no_games]

    def begin(self, envs: Indices, opponents: Indices, sides: Indices) -> None:
        """Episodes start, before the Turn that reports the end of the previous ones.

        opponents: their numbers, -1 in self-play. sides: the learner's. Both (m,).
        """
        self._next_opponents[envs], self._next_sides[envs] = opponents, sides

    def add_turn(self, turn: Turn) -> None:
        """Add rewards, and the games that have ended."""
        for rows in turn.endings:
            self._returns[rows.envs, rows.agents] += rows.rewards
        opposed = turn.finished[self.opponents[turn.finished] >= 0]
        if len(opposed):
            self._episodes.append(self.opponents[opposed])
            if self._is_scored:
                self._finished.append(self._games(opposed))
        self.forget(np.concatenate([turn.finished, turn.crashed]))
        for batch in turn.batches.values():
            self._returns[batch.envs, batch.agents] += batch.rewards
        self.opponents[:], self._sides[:] = self._next_opponents, self._next_sides

    def forget(self, envs: Indices) -> None:
        """Drop the open episodes of some environments."""
        self._returns[envs] = 0

    def take(self, opponents: int) -> OpponentResults:
        """Return the results since the last call. opponents: the number of all opponents."""
        columns = ([getattr(part, name) for part in self._finished] for name in OpposedGames.__slots__)
        games, waiting = OpposedGames(*map(np.concatenate, columns)), self._no_games
        if self._scoring == "side":
            games, waiting = games.blocks()
        numbers = np.concatenate([NO_ROWS, *self._episodes])
        self._episodes, self._finished = [], [waiting]
        return OpponentResults(
            np.bincount(numbers, minlength=opponents).astype(np.int64),
            np.bincount(games.opponents, minlength=opponents).astype(np.int64),
            np.bincount(games.opponents, weights=games.scores(), minlength=opponents).astype(np.float64),
        )

    def _games(self, envs: Indices) -> OpposedGames:
        sides = self._sides[envs]
        # Sorting makes the means of equal returns equal in every bit.
        of_sides = np.stack(
            [np.sort(self._returns[envs][:, members], axis=1).mean(axis=1) for members in self._members], axis=1
        )
        is_own = np.arange(len(self._members)) == sides[:, np.newaxis]
        other_returns = of_sides[~is_own].reshape(len(envs), -1)
        return OpposedGames(self.opponents[envs], sides, of_sides[is_own], other_returns)
