"""Scores the learner's games against its opponents by the rule of the league's matches.

`league.results.scoring` defines the rule. If sides are symmetric, the learner's return is compared with the opponent's
in each game. If they are not, two games with the learner on either side form a block, and returns on the same side are
compared; games without a partner are dropped. Unlike those of a match, the games of such a block have different seeds.
If there are more than two such sides, games are not scored: the learner never has all sides but one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Indices, Turn
from league.results.records import Scoring


@dataclass(frozen=True, slots=True)
class ScoredGames:
    """Games against each opponent and the sum of the learner's scores in them, both (opponents,)."""

    games: NDArray[np.int64]
    scores: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OpposedGames:
    """m finished games: the opponent's number, the learner's side, and the returns of both, each (m,)."""

    opponents: Indices
    sides: Indices
    own: NDArray[np.float64]
    other: NDArray[np.float64]

    def scored(self, scoring: Scoring, opponents: int) -> ScoredGames:
        """Score the games. opponents: the number of all opponents."""
        if scoring == "game":
            return self._summed(_compare(self.own, self.other), self.opponents, opponents)
        scores, numbers = [np.zeros(0)], [np.zeros(0, np.int64)]
        for opponent in np.unique(self.opponents).tolist():
            first, second = (np.flatnonzero((self.opponents == opponent) & (self.sides == side)) for side in (0, 1))
            blocks = min(len(first), len(second))
            first, second = first[:blocks], second[:blocks]
            scores += [_compare(self.own[first], self.other[second]), _compare(self.own[second], self.other[first])]
            numbers.append(np.full(2 * blocks, opponent))
        return self._summed(np.concatenate(scores), np.concatenate(numbers), opponents)

    @staticmethod
    def _summed(scores: NDArray[np.float64], numbers: Indices, opponents: int) -> ScoredGames:
        games = np.bincount(numbers, minlength=opponents).astype(np.int64)
        summed = np.bincount(numbers, weights=scores, minlength=opponents).astype(np.float64)
        return ScoredGames(games, summed)


def _compare(mine: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(mine > other, 1.0, np.where(mine == other, 0.5, 0.0))


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
        self._finished: list[OpposedGames] = []

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
        if len(opposed) and self._is_scored:
            self._finished.append(self._games(opposed))
        self.forget(np.concatenate([turn.finished, turn.crashed]))
        for batch in turn.batches.values():
            self._returns[batch.envs, batch.agents] += batch.rewards
        self.opponents[:], self._sides[:] = self._next_opponents, self._next_sides

    def forget(self, envs: Indices) -> None:
        """Drop the open episodes of some environments."""
        self._returns[envs] = 0

    def take(self, opponents: int) -> ScoredGames:
        """Return the scores since the last call. opponents: the number of all opponents."""
        finished, self._finished = self._finished, []
        columns = (
            np.concatenate([getattr(games, name) for games in finished] or [np.zeros(0, np.int64)])
            for name in OpposedGames.__slots__
        )
        return OpposedGames(*columns).scored(self._scoring, opponents)

    def _games(self, envs: Indices) -> OpposedGames:
        sides = self._sides[envs]
        # Sorting makes the means of equal returns equal in every bit.
        of_sides = np.stack(
            [np.sort(self._returns[envs][:, members], axis=1).mean(axis=1) for members in self._members], axis=1
        )
        is_own = np.arange(len(self._members)) == sides[:, np.newaxis]
        others = np.sort(of_sides[~is_own].reshape(len(envs), -1), axis=1)
        return OpposedGames(self.opponents[envs], sides, of_sides[is_own], others.mean(axis=1))
