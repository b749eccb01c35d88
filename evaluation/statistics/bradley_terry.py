"""Bradley–Terry ratings of all contestants from the blocks they played, with intervals.

Contestant `i` scores against `j` with expectation `1 / (1 + 10^((r_j - r_i)/400))`; a draw counts as half a win for
each. Ratings maximise the likelihood of all games plus a prior of at most **one virtual draw per contestant**, divided
among its opponents. They are differences to the anchor, and so are their intervals.

Intervals are normal, with the sandwich estimator of the variance: blocks are independent, their games are not. Pairs
whose blocks say little about their variance borrow it from the model and from the other pairs. An undefeated contestant
therefore has a wide interval, although its blocks do not vary.

Sources: R. A. Bradley and M. E. Terry, "Rank analysis of incomplete block designs" (1952); D. R. Hunter, "MM
algorithms for generalized Bradley–Terry models" (2004) for existence and connectedness; H. White, "Maximum likelihood
estimation of misspecified models" (1982); P. McCullagh and J. Nelder, "Generalized linear models" (1989), 4.5, for the
dispersion.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.csgraph import connected_components
from scipy.special import expit, ndtri

from evaluation.statistics.blas import single_threaded_blas
from league.results.records import Outcome

Floats = NDArray[np.float64]

ELO = 400 / math.log(10)
"""Elo per unit of log odds."""

TOLERANCE = 1e-6
"""A fit has converged when no difference of two log odds moves by more."""

MOST_STEPS = 1000
"""Steps of a fit: rounding of many millions of games may keep the last ones from vanishing."""

WIDE = 100.0
"""Standard deviation of log odds without any game, which makes them finite for contestants that no game connects."""

BORROWED = 2.0
"""Information, in that of eight even games, with which a pair's own variance counts half."""


@dataclass(frozen=True, slots=True)
class Rating:
    """Elo above the anchor with the bounds of its interval; all None without a chain of games to the anchor."""

    elo: float | None
    low: float | None
    high: float | None


def rate(results: Iterable[Outcome], anchor: str, *, confidence: float = 0.95) -> dict[str, Rating]:
    """Rate all contestants in `results`. The result does not depend on their order.

    Args:
        results: Outcomes of matches (blocks), of two contestants each.
        anchor: Reference of the contestant whose rating is 0.
        confidence: Coverage of the intervals.

    Returns:
        Reference → rating in Elo, including the anchor.
    """
    blocks = list(results)
    names = sorted({anchor}.union(*(block.contestants for block in blocks)))
    number = {name: i for i, name in enumerate(names)}
    sums = _sums([block for block in blocks if len(set(block.contestants)) == 2], number)
    component = connected_components(sums[1], directed=False)[1]
    rated = np.flatnonzero(component == component[number[anchor]])
    with single_threaded_blas():
        strength, deviation = _fitted(sums[:, rated][:, :, rated], int(np.searchsorted(rated, number[anchor])))
    half = float(ndtri((1 + confidence) / 2)) * deviation
    bounds = ELO * np.stack([strength, strength - half, strength + half], axis=1)
    ratings = dict.fromkeys(names, Rating(None, None, None))
    return ratings | {names[i]: Rating(*row) for i, row in zip(rated, bounds.tolist(), strict=True)}


def _sums(blocks: list[Outcome], number: dict[str, int]) -> Floats:
    """Sums over the blocks of i against j, (5, n, n): i's points, games, squared points, points × games, squared games.

    number: contestant → index.
    """
    players = np.array([[number[name] for name in block.contestants] for block in blocks], np.int64).reshape(-1, 2)
    scores = np.array([block.scores for block in blocks], np.float64).reshape(-1, 2)
    games = np.array([block.games for block in blocks], np.float64)
    matches = np.array([block.matches for block in blocks], np.float64)
    sums = np.zeros((5, len(number), len(number)))
    for side, points in enumerate(scores.T):
        for total, term in zip(sums, (points, games, points**2, points * games, games**2), strict=True):
            np.add.at(total, (players[:, side], players[:, 1 - side]), matches * term)
    return sums


def _fitted(sums: Floats, anchor: int) -> tuple[Floats, Floats]:
    """Log odds (n,) above the anchor, and the standard deviations (n,) of these differences."""
    points, games, squared_points, products, squared_games = sums
    strength, precision = posterior(points, games)
    expected = expit(strength[:, None] - strength)
    information = games * expected * (1 - expected)
    squares = squared_points - 2 * expected * products + expected**2 * squared_games
    dispersion = (squares.sum() / 2 + BORROWED) / (information.sum() / 2 + BORROWED)
    variance = information * (squares + BORROWED * dispersion) / (information + BORROWED)
    variance += virtual_draws(games) * expected * (1 - expected)
    covariance = cho_solve(cho_factor(precision), np.eye(len(strength)))
    sandwich = covariance @ (np.diag(variance.sum(axis=1)) - variance) @ covariance
    of_gaps = np.diag(sandwich) + sandwich[anchor, anchor] - 2 * sandwich[anchor]
    return strength - strength[anchor], np.sqrt(np.maximum(of_gaps, 0.0))


def posterior(points: Floats, games: Floats) -> tuple[Floats, Floats]:
    """Fit ratings to sums of games.

    Args:
        points: `points[i, j]`: what i scored against j, shape (n, n).
        games: Number of games of each pair, shape (n, n).

    Returns:
        Maximum a posteriori log odds (n,), which add up to 0, and the precision (n, n) of the normal approximation.
    """
    draws = virtual_draws(games)
    points, games = points + draws / 2, games + draws
    strength = np.zeros(len(games))
    for _ in range(MOST_STEPS):
        expected = expit(strength[:, None] - strength)
        information = games * expected * (1 - expected)
        precision = np.diag(information.sum(axis=1) + WIDE**-2) - information
        gradient = (points - games * expected).sum(axis=1) - strength / WIDE**2
        step = cho_solve(cho_factor(precision), gradient)
        change = np.ptp(step)
        if change < TOLERANCE:
            break
        # Far from the maximum, a full Newton step may overshoot. The likelihood increases if no difference changes by
        # more than one unit of log odds.
        strength = strength + step / max(1.0, change)
    return strength, precision


def virtual_draws(games: Floats) -> Floats:
    """The prior, as draws of each pair (n, n), in proportion to its games: at most one for each contestant.

    The smaller share counts: a contestant that all others met, such as the anchor, would get more than one otherwise. A
    prior that draws all towards one value would add up along versions that met only their predecessors: the more of
    them, the closer together they would seem.
    """
    share = games / np.maximum(games.sum(axis=1, keepdims=True), 1.0)
    return np.minimum(share, share.T)
