"""Probabilities of the opponents in training, from the learner's scores and their payoff matrix.

x is the probability that the learner beats an opponent, where draws count ½.

- **pfsp**: prioritised fictitious self-play (O. Vinyals et al., "Grandmaster level in StarCraft II using multi-agent
  reinforcement learning", Nature 575, 2019), with the weight (1 - x)^p, x(1 - x) or min(½, 1 - x);
- **nash**, **alpha_rank**: policy-space response oracles (M. Lanctot et al., "A unified game-theoretic approach to
  multiagent reinforcement learning", NeurIPS 2017): the meta-strategy of the candidates' payoff matrix.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from league.config.opponents import LeagueOpponentsConfig, Weighting
from league.results.equilibria import alpha_rank, nash_averaging
from league.results.payoffs import UNKNOWN

Floats = NDArray[np.float64]

FORGOTTEN_BELOW = 0.7
"""An opponent that the learner beats with a lower probability counts as forgotten."""


def opponent_distribution(settings: LeagueOpponentsConfig, scores: ArrayLike, payoff: ArrayLike) -> Floats:
    """Return the probability of each opponent.

    Args:
        settings: How opponents are drawn.
        scores: x for each opponent in order of age, the newest last, (n,). NaN if unknown, which counts as ½.
        payoff: Mean score of each opponent against each other, (n, n), NaN if unknown.

    Returns:
        Probabilities, (n,); empty without opponents.
    """
    x = known(scores)
    if not len(x):
        return x
    uniform, payoffs = np.full(len(x), 1 / len(x)), known(payoff)
    # Scores of a pair add up to 1, with ½ on the diagonal.
    table = (payoffs + 1 - payoffs.T) / 2
    match settings.sampling:
        case "latest":
            drawn = np.eye(len(x))[-1]
        case "uniform":
            drawn = uniform
        case "pfsp":
            weights = pfsp_weights(x, settings.weighting, settings.power)
            drawn = weights / weights.sum() if weights.sum() > 0 else uniform
        case "nash":
            drawn = nash_averaging(2 * table - 1)[0]
        case "alpha_rank":
            drawn = alpha_rank(table) if len(x) > 1 else uniform
    forgotten = x < FORGOTTEN_BELOW
    if not forgotten.any():
        return drawn
    return np.asarray((1 - settings.forgotten) * drawn + settings.forgotten * forgotten / forgotten.sum())


def pfsp_weights(scores: Floats, weighting: Weighting, power: float) -> Floats:
    """Return the weights of opponents whom the learner beats with probabilities `scores`, (n,)."""
    match weighting:
        case "power":
            return np.asarray((1 - scores) ** power)
        case "variance":
            return scores * (1 - scores)
        case "linear_capped":
            return np.minimum(0.5, 1 - scores)


def systematic_counts(probabilities: Floats, draws: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return how often each opponent is drawn, (n,).

    Systematic sampling uses one random number for all draws: the expected count is `draws` times the probability, and
    the count differs from it by less than 1.
    """
    points = (rng.random() + np.arange(draws)) / draws
    bounds = np.cumsum(probabilities)
    return np.bincount(np.searchsorted(bounds / bounds[-1], points, side="right"), minlength=len(bounds))


def known(scores: ArrayLike) -> Floats:
    """Return scores with ½ in place of NaN."""
    return np.nan_to_num(np.asarray(scores, dtype=np.float64), nan=UNKNOWN)
