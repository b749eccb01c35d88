"""Payoff matrix of a league's contestants, and its meta-strategy: the Nash equilibrium or the α-Rank of the matrix."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.errors import NotFound
from league.results.equilibria import alpha_rank, nash_averaging
from league.results.records import Outcome

METHODS = ("nash", "alpha_rank")
UNKNOWN = 0.5
"""Score of a pair without games."""
PRIOR_GAMES = 10.0
"""Weight of the prior, in games."""

Scores = dict[str, tuple[float, float]]
"""Opponent → number of games, and the sum of the scores in them."""


@dataclass(frozen=True, slots=True)
class MetaStrategy:
    """Probabilities of contestants.

    Attributes:
        refs: The contestants that have played each other, (n,).
        probabilities: Of each, (n,).
        payoff: Mean score of each against each other, (n, n).
        games: Number of games between them.
        unmet: Number of pairs without a game, which count as equally strong.
    """

    refs: tuple[str, ...]
    probabilities: tuple[float, ...]
    payoff: tuple[tuple[float, ...], ...]
    games: float
    unmet: int

    def scores(self, shares: Mapping[str, float]) -> tuple[float, ...]:
        """Return the mean score of each contestant against an opponent that is drawn from `shares`, (n,).

        shares: contestant → probability, which is 0 for those that it lacks.
        """
        drawn = np.array([shares.get(ref, 0.0) for ref in self.refs])
        return tuple((np.array(self.payoff) @ drawn).tolist())


def meta_strategy(refs: Sequence[str], results: Iterable[Outcome], method: str = "nash") -> MetaStrategy:
    """Compute the meta-strategy of some contestants. Those without a game against another one are left out.

    Args:
        refs: The contestants.
        results: The matches of the league.
        method: `nash`: the equilibrium of maximum entropy. `alpha_rank`: the share of time that an imitating
            population spends at each.

    Raises:
        ValueError: The method is unknown.
        NotFound: There are fewer than two contestants, or no two have played each other.
    """
    if method not in METHODS:
        raise ValueError(f"method {method!r}: expected {' or '.join(METHODS)}")
    if len(refs) < 2:
        raise NotFound(
            f"expected at least two versions, the league has {len(refs)}: `league train CONFIG` publishes them"
        )
    contestants = set(refs)
    pairs = [
        result for result in results if len(set(result.contestants)) == 2 and contestants >= set(result.contestants)
    ]
    playing = tuple(ref for ref in refs if any(ref in result.contestants for result in pairs))
    if not playing:
        raise NotFound(
            f"no two of the {len(refs)} versions have played each other: `league evaluate LEAGUE` lets them play"
        )
    table = payoff_matrix(playing, pairs, {})
    shares = nash_averaging(2 * table - 1)[0] if method == "nash" else alpha_rank(table)
    met = {frozenset(result.contestants) for result in pairs}
    return MetaStrategy(
        refs=playing,
        probabilities=tuple(shares.tolist()),
        payoff=tuple(map(tuple, table.tolist())),
        games=sum(result.games * result.matches for result in pairs),
        unmet=len(playing) * (len(playing) - 1) // 2 - len(met),
    )


def payoff_matrix(
    contestants: Sequence[str], results: Iterable[Outcome], rows: Mapping[str, Scores]
) -> NDArray[np.float64]:
    """Return the mean score of each contestant against each other, shrunk towards ½, (n, n).

    results: of the league's matches. rows: contestant → its scores in training games.
    """
    number = {ref: i for i, ref in enumerate(contestants)}
    games, scores = np.zeros((2, len(number), len(number)))

    def add(first: str, second: str, count: float, score: float) -> None:
        if first in number and second in number:
            i, j = number[first], number[second]
            games[i, j] += count
            games[j, i] += count
            scores[i, j] += score
            scores[j, i] += count - score

    for result in results:
        if len(result.contestants) == 2:
            add(*result.contestants, result.games * result.matches, result.scores[0] * result.matches)
    for ref, row in rows.items():
        for other, (count, score) in row.items():
            add(ref, other, count, score)
    return np.asarray(shrunk(games, scores, UNKNOWN))


def shrunk(games: Any, score: Any, prior: float) -> Any:
    """Return a mean score, or an array of them, shrunk towards `prior`. score: the sum over the games."""
    return (score + PRIOR_GAMES * prior) / (games + PRIOR_GAMES)
