"""Cross-play: how well policies play in one team that were not trained together (zero-shot coordination).

H. Hu et al., "'Other-play' for zero-shot coordination", ICML 2020: the matrix of mean team returns of all pairs, with
self-play on the diagonal; what a policy loses off the diagonal is what it relied on its own conventions for.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np

from evaluation.paired import student
from evaluation.report import CrossPlay, Estimate
from league.results.records import Game, Match


def cross_play_table(contestants: Sequence[str], matches: Iterable[Match]) -> CrossPlay:
    """Mean team returns of all pairs of `contestants`; None for those that have not played together.

    Matches are independent, the two games of one are not: intervals are over matches. Those with a forfeited game are
    left out: such a game has no return.
    """
    cells: defaultdict[tuple[str, str], list[float]] = defaultdict(list)
    teams: defaultdict[frozenset[str], list[float]] = defaultdict(list)
    for match in matches:
        if any(game.forfeits for game in match.games):
            continue
        returns = [team_return(game) for game in match.games]
        teams[frozenset(match.contestants)].append(float(np.mean(returns)))
        if len(set(match.contestants)) == 1:
            cells[match.contestants[0], match.contestants[0]].append(float(np.mean(returns)))
            continue
        for seat, value in enumerate(returns):
            # Contestant 0 has the seat in game 0, contestant 1 in game 1.
            cells[match.contestants[seat], match.contestants[1 - seat]].append(value)
    return CrossPlay(
        contestants=tuple(contestants),
        returns=tuple(tuple(_estimate(cells[row, column]) for column in contestants) for row in contestants),
        own=_stratified([values for team, values in teams.items() if len(team) == 1]),
        mixed=_stratified([values for team, values in teams.items() if len(team) > 1]),
    )


def team_return(game: Game) -> float:
    """The mean return over the agents of the team: each is a side, and a contestant's return is the mean of its own."""
    total = 0.0
    for contestant, value in enumerate(game.returns):
        total += 0.0 if value is None else value * game.sides.count(contestant)
    return total / len(game.sides)


def _estimate(values: Sequence[float]) -> Estimate | None:
    if not values:
        return None
    mean = student(values)
    return Estimate(mean.mean, mean.low, mean.high)


def _stratified(teams: Sequence[Sequence[float]]) -> Estimate | None:
    """The mean over teams of their means, each known to its own standard error; ± 1.96 of the whole."""
    if not teams:
        return None
    mean = float(np.mean([np.mean(values) for values in teams]))
    if any(len(values) < 2 for values in teams):
        return Estimate(mean, None, None)
    error = float(np.sqrt(sum(np.var(values, ddof=1) / len(values) for values in teams))) / len(teams)
    return Estimate(mean, mean - 1.96 * error, mean + 1.96 * error)
