"""Payoff and cross-play matrices: mean scores, mean returns and paired differences of contestants.

Both games of a block share seed and opening, so the value of a seed cancels in the difference of a block's returns.
Blocks are independent and the games of a block are not, so intervals are computed over blocks with Student's t.

Cross-play measures zero-shot coordination: how well policies that were not trained together play in one team (H. Hu et
al., "'Other-play' for zero-shot coordination", ICML 2020). The diagonal of its matrix is self-play; the loss off the
diagonal shows how much a policy relies on its own conventions.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit

from evaluation.documents import CrossPlay, Difference, Estimate, Payoff
from league.results.records import Game, Match
from league.results.sums import GameSums, Pair, PairSums, tally, whole

Floats = NDArray[np.float64]


def paired_difference(matches: Iterable[Match], contestant: str, confidence: float = 0.95) -> Difference | None:
    """Mean return of `contestant` minus that of its opponent.

    Matches with a forfeited game are left out, because a partial return can exceed that of a whole game. After a
    sequential stop, the interval is conditional on having stopped, and optimistic.

    Args:
        matches: Matches between `contestant` and one opponent.
        contestant: Reference of one of the two.
        confidence: Coverage of the interval.

    Returns:
        The difference in the environment's unit of returns, or None without complete matches.
    """
    sums = next(iter(tally(matches).items()), None)
    if sums is None:
        return None
    (first, _), of_pair = sums
    return _difference(of_pair.whole, first == contestant, confidence)


def _difference(sums: GameSums, of_first: bool, confidence: float = 0.95) -> Difference | None:
    """Mean difference of the returns of two contestants. of_first: the first's minus the second's, or the opposite."""
    number, gap = sums.complete, sums.gap if of_first else -sums.gap
    if not number:
        return None
    mean = float(Fraction(gap) / number)
    if number == 1:
        return Difference(mean, None, None)
    variance = (number * sums.squares - gap * gap) / Fraction(number * (number - 1))
    half = float(stdtrit(number - 1, 0.5 + confidence / 2)) * math.sqrt(variance / number)
    return Difference(mean, mean - half, mean + half)


def score_interval(scores: Sequence[float], confidence: float = 0.95) -> tuple[float, float, float]:
    """Mean of independent scores in [0, 1] with Wilson's interval.

    A score in [0, 1] with the mean μ has at most the variance μ(1 − μ) of a Bernoulli variable, for which the interval
    is made, so it is conservative. Unlike Student's, it has a width if all scores are equal. E. B. Wilson, "Probable
    inference, the law of succession, and statistical inference" (1927).

    Args:
        scores: At least one score.
        confidence: Coverage of the interval.

    Returns:
        Mean, lower and upper bound.
    """
    number, mean = len(scores), float(np.mean(scores))
    z2 = float(ndtri(0.5 + confidence / 2)) ** 2
    centre = (mean + z2 / (2 * number)) / (1 + z2 / number)
    half = math.sqrt(z2 * (mean * (1 - mean) / number + z2 / (4 * number**2))) / (1 + z2 / number)
    return mean, max(centre - half, 0.0), min(centre + half, 1.0)


def student_interval(values: Sequence[float], confidence: float = 0.95) -> Difference:
    """Mean of independent values with Student's interval, mean ± t s/√N. A single value has no interval."""
    number, mean = len(values), float(np.mean(values))
    if number == 1:
        return Difference(mean, None, None)
    half = float(stdtrit(number - 1, 0.5 + confidence / 2)) * float(np.std(values, ddof=1)) / math.sqrt(number)
    return Difference(mean, mean - half, mean + half)


def crossed_interval(values: Floats, confidence: float = 0.95) -> Difference:
    """Mean of values that depend on two independent samples, with an interval for both.

    values[r, c] has an effect of row r and one of column c. With the sample variances v of the row means and w of the
    column means, the variance of the mean is estimated as v/R + w/C. This counts the interaction of rows and columns
    twice, so it is conservative. The degrees of freedom of Student's t are Satterthwaite's. A. B. Owen, "The pigeonhole
    bootstrap" (2007); F. E. Satterthwaite, "An approximate distribution of estimates of variance components" (1946).

    Args:
        values: Shape (R, C). With a single row or column there is no interval.
        confidence: Coverage of the interval.
    """
    mean = float(values.mean())
    if min(values.shape) < 2:
        return Difference(mean, None, None)
    half = _half_width([values.mean(axis=1).tolist(), values.mean(axis=0).tolist()], confidence)
    return Difference(mean, mean - half, mean + half)


def _half_width(samples: Sequence[Sequence[float]], confidence: float = 0.95) -> float:
    """Half the width of Student's interval for the sum of the means of independent samples of at least two values."""
    parts = [float(np.var(sample, ddof=1)) / len(sample) for sample in samples]
    variance = sum(parts)
    if variance == 0:
        return 0.0
    freedom = variance**2 / sum(part**2 / (len(sample) - 1) for part, sample in zip(parts, samples, strict=True))
    return float(stdtrit(freedom, 0.5 + confidence / 2)) * math.sqrt(variance)


Row = tuple[float | None, ...]


def tabulate(contestants: Sequence[str], sides: Sequence[str], sums: Mapping[Pair, PairSums]) -> Payoff:
    """Payoff matrix: mean scores, games and paired differences of each ordered pair of `contestants`.

    `score[i][j] + score[j][i] = 1` for pairs that met, and `difference[i][j].mean = -difference[j][i].mean`. A game
    counts for a side if the row's contestant played that side and no other.

    Args:
        contestants: References in the order of rows and columns.
        sides: Names of the sides.
        sums: Over the matches between these contestants.
    """
    gaps: dict[Pair, Difference | None] = {}
    for (first, second), of_pair in sums.items():
        gap = gaps[first, second] = _difference(of_pair.whole, of_first=True)
        gaps[second, first] = gap and gap.opposite
    scores, games = _cells(contestants, whole(sums))
    return Payoff(
        tuple(contestants),
        scores,
        games,
        {
            side: _cells(contestants, {pair: of.sides[number] for pair, of in sums.items() if number in of.sides})[0]
            for number, side in enumerate(sides)
        },
        tuple(tuple(gaps.get((row, column)) for column in contestants) for row in contestants),
    )


def _cells(
    contestants: Sequence[str], sums: Mapping[Pair, GameSums]
) -> tuple[tuple[Row, ...], tuple[tuple[int, ...], ...]]:
    """Mean scores and numbers of games of each ordered pair of contestants."""
    cells: dict[Pair, tuple[float, int]] = {}
    for (first, second), of_pair in sums.items():
        if played := of_pair.played:
            points = of_pair.points
            cells[first, second], cells[second, first] = (points[0] / played, played), (points[1] / played, played)
    rows = [[cells.get((row, column), (None, 0)) for column in contestants] for row in contestants]
    return tuple(tuple(score for score, _ in row) for row in rows), tuple(tuple(n for _, n in row) for row in rows)


def cross_play_table(contestants: Sequence[str], matches: Iterable[Match]) -> CrossPlay:
    """Mean team returns of all pairs of `contestants`; None for pairs that have not played together.

    Matches are independent and the two games of a match are not, so intervals are computed over matches. Matches with a
    forfeited game have no return and are left out.
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
            # Contestant i has the seat in game i.
            cells[match.contestants[seat], match.contestants[1 - seat]].append(value)
    return CrossPlay(
        contestants=tuple(contestants),
        returns=tuple(tuple(_estimate(cells[row, column]) for column in contestants) for row in contestants),
        own=_stratified([values for team, values in teams.items() if len(team) == 1]),
        mixed=_stratified([values for team, values in teams.items() if len(team) > 1]),
    )


def team_return(game: Game) -> float:
    """Mean return over the agents of the team, where each agent is a side."""
    total = 0.0
    for contestant, value in enumerate(game.returns):
        total += 0.0 if value is None else value * game.sides.count(contestant)
    return total / len(game.sides)


def _estimate(values: Sequence[float]) -> Estimate | None:
    if not values:
        return None
    mean = student_interval(values)
    return Estimate(mean.mean, mean.low, mean.high)


def _stratified(teams: Sequence[Sequence[float]]) -> Estimate | None:
    """Mean over teams of their means, with Student's interval."""
    if not teams:
        return None
    mean = float(np.mean([np.mean(values) for values in teams]))
    if any(len(values) < 2 for values in teams):
        return Estimate(mean, None, None)
    half = _half_width(teams) / len(teams)
    return Estimate(mean, mean - half, mean + half)
