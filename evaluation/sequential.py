"""Sequential tests: the generalised SPRT on block scores, and a betting test on paired differences of returns.

A *block* is `n` games between two contestants from one opening, the sides rotated, so that seat and luck cancel; its
score lies on the grid `a_i = i / 2n`, `i = 0 … 2n`. One game per block gives the trinomial cells (L, D, W), two give
the pentanomial cells (LL, LD, DD+WL, WD, WW). Blocks are independent, the games inside a block are not.

Two models say what "Elo" means:

* `logistic`: the expected score is `s(e) = 1 / (1 + 10^(-e/400))`;
* `normalized`: the effect size of one game is `(mu - 1/2) / sigma = e / (800 / ln 10)`. For a block of `n` games it
  is `sqrt(n)` times that. It measures how fast a test can tell two contestants apart, whatever their share of draws.

The log likelihood ratio of the test `H1: elo = elo1` against `H0: elo = elo0` after `N` blocks with empirical
cell frequencies `q_i` is `N * sum_i q_i ln(p1_i / p0_i)`, where `p0` and `p1` are the maximum likelihood
distributions under the constraint of each hypothesis. Empty cells count as 1e-3.

Sources: M. Van den Bergh's notes on fishtest, cantate.be/Fishtest: support_MLE_multinomial.pdf (Proposition 1.1) and
normalized_elo_practical.pdf (section 4.1); A. Wald, "Sequential tests of statistical hypotheses" (1945); A. Owen,
"Empirical likelihood ratio confidence intervals for a single functional" (1988) for the constrained estimate; D.
Siegmund, "Sequential Analysis" (1985), chapter 8, for the overshoot; I. Waudby-Smith and A. Ramdas, "Estimating means
of bounded random variables by betting" (arXiv 2010.09686); S. Howard et al., "Time-uniform, nonparametric,
nonasymptotic confidence sequences" (arXiv 1810.08240), for the mixture over Bernoulli probabilities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import betaln, ndtri

Model = Literal["logistic", "normalized"]
Floats = NDArray[np.float64]

ELO_PER_EFFECT = 800 / math.log(10)
"""Normalised Elo of an effect size of one standard deviation per game."""

EMPTY_CELL = 1e-3
"""What an empty cell counts, so that every distribution has full support."""

LARGEST_EFFECT = 0.8
"""Normalised hypotheses reach this many standard deviations of a block: beyond one the constrained estimate
need not exist, and towards it the estimate settles ever more slowly."""

MAX_STEPS = 2000
"""Steps of the constrained estimate; a dozen are usual, hundreds occur at a few blocks and large effects."""

MAX_NEWTON_STEPS = 100
"""Steps of one tilt; half a dozen are usual, dozens of bisections where a cell is empty."""


@dataclass(frozen=True, slots=True)
class EloEstimate:
    """Elo of the first contestant over the second, with the bounds of a two-sided interval."""

    elo: float
    low: float
    high: float


def bounds(alpha: float, beta: float) -> tuple[float, float]:
    """Wald's bounds of the LLR: at most `ln(beta / (1 - alpha))` accepts H0, at least `ln((1 - beta) / alpha)` H1.

    `alpha` is the chance to accept H1 at `elo0`, `beta` the chance to accept H0 at `elo1`.
    """
    if not (alpha > 0 and beta > 0 and alpha + beta < 1):
        raise ValueError(f"alpha and beta must be positive with a sum below 1, not {alpha} and {beta}")
    return math.log(beta / (1 - alpha)), math.log((1 - beta) / alpha)


def overshoot(curve: ArrayLike) -> tuple[float, float]:
    """By how much the LLR is expected to jump over the lower and over the upper bound when it leaves them, both >= 0.

    A test that stops at the bounds themselves errs less than it may, since it stops beyond them. Moved inwards by this
    (`lower + first`, `upper - second`), it errs as often as it may, and stops sooner. Estimated from the ladder heights
    h of the curve so far, its steps to a new extreme, as E h² / 2 E h (Siegmund, equation 8.49).

    curve: the LLR after each block, as `gsprt_llr` of all prefixes gives it.
    """
    llr = np.concatenate([[0.0], np.asarray(curve, dtype=np.float64)])
    return _ladder(np.minimum.accumulate(llr)), _ladder(np.maximum.accumulate(llr))


def _ladder(extremes: Floats) -> float:
    heights = np.abs(np.diff(extremes))
    return float((heights**2).sum() / (2 * heights.sum())) if heights.any() else 0.0


@dataclass(frozen=True, slots=True)
class BettingTest:
    """An anytime-valid test of independent differences `d` within ±bound, whatever their distribution.

    H0: the mean is at most `low`; H1: it is at least `high`. A gambler bets on each difference before it is seen, at
    odds that are fair under the hypothesis that is to be refuted; the chance that its wealth ever reaches `1 / a` is at
    most `a` then (Ville). So the test may stop at any time, and looks as often as it likes. For few blocks, and for
    returns that no likelihood is known of.

    The bet on `x = (1 + d / bound) / 2` against a mean of `m` is `clip((mu - m) / (s² + (mu - m)²), 0, c / m)`, with
    mean and variance of all before it (the approximate GRAPA bet of Waudby-Smith and Ramdas, section B.3).
    """

    bound: float
    alpha: float
    beta: float
    low: float = 0.0
    high: float = 0.0

    def __post_init__(self) -> None:
        if not (self.bound > 0 and 0 < self.alpha < 1 and 0 < self.beta < 1):
            raise ValueError(f"bound must be positive, alpha and beta within (0, 1), not {self}")
        if not -self.bound < self.low <= self.high < self.bound:
            raise ValueError(f"low and high must lie within ±{self.bound:g}, low first, not {self.low} and {self.high}")

    @property
    def bounds(self) -> tuple[float, float]:
        """Of the two log wealths: `ln(1 / beta)` accepts H0, `ln(1 / alpha)` accepts H1."""
        return math.log(1 / self.beta), math.log(1 / self.alpha)

    def curves(self, differences: ArrayLike) -> tuple[Floats, Floats]:
        """Log wealth of who bets against H1, and of who bets against H0, after each difference.

        differences: `(..., N)`. Returns two arrays of that shape. Raises ValueError for one beyond ±bound.
        """
        x = (1 + np.asarray(differences, dtype=np.float64) / self.bound) / 2
        if not ((x >= 0) & (x <= 1)).all():
            raise ValueError(f"differences must lie within ±{self.bound:g}")
        low, high = ((1 + edge / self.bound) / 2 for edge in (self.low, self.high))
        return _log_wealth(1 - x, 1 - high), _log_wealth(x, low)

    def decide(self, differences: ArrayLike) -> tuple[Literal["H0", "H1"] | None, int]:
        """What one series `(N,)` decides, and after how many differences; None and N while the test is open."""
        curves = np.stack(self.curves(differences))
        crossed = np.flatnonzero((curves >= np.array(self.bounds)[:, None]).any(axis=0))
        if not crossed.size:
            return None, curves.shape[1]
        first = int(crossed[0])
        return ("H1" if curves[1, first] >= self.bounds[1] else "H0"), first + 1


BOLDNESS = 0.75
"""Share of its wealth that a bet may lose at most."""


def _log_wealth(x: Floats, mean: float) -> Floats:
    """Of who bets that the mean of x in [0, 1] is greater than `mean`: `sum ln(1 + bet (x - mean))`."""
    seen = np.arange(1, x.shape[-1] + 1)
    before = np.cumsum(x, axis=-1) - x
    guess = (0.5 + before) / seen
    deviations = (x - (0.5 + np.cumsum(x, axis=-1)) / (seen + 1)) ** 2
    variance = (0.25 + np.cumsum(deviations, axis=-1) - deviations) / seen
    edge = guess - mean
    bet = np.clip(edge / (variance + edge**2), 0.0, BOLDNESS / mean)
    return np.asarray(np.cumsum(np.log1p(bet * (x - mean)), axis=-1))


def bernoulli_interval(successes: int, trials: int, alpha: float = 0.05, best_at: float = 100.0) -> tuple[float, float]:
    """An interval for a probability that covers it at all times at once with probability `1 - alpha`.

    It may be looked at after every trial. best_at: trials at which it is about as narrow as it can be. It holds the p
    of which a mixture of Bernoulli likelihoods, Beta-distributed around p, is less than `1 / alpha` times as likely
    (Howard et al., proposition 7).
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"successes must be of at least one trial, not {successes} of {trials}")
    failures = trials - successes

    def refuted(p: float) -> float:
        variance = p * (1 - p)
        scale = 2 * math.log(1 / MIXTURE_ALPHA)
        rho = best_at * variance / (scale + math.log(1 + scale))
        r = max(rho - variance, 1e-3 * variance)
        a, b = r / (1 - p), r / p
        mixture = betaln(a + successes, b + failures) - betaln(a, b)
        return float(mixture - successes * math.log(p) - failures * math.log(1 - p) + math.log(alpha))

    estimate = min(max(successes / trials, EDGE), 1 - EDGE)
    low = brentq(refuted, EDGE, estimate) if successes and refuted(EDGE) > 0 else 0.0
    high = brentq(refuted, estimate, 1 - EDGE) if failures and refuted(1 - EDGE) > 0 else 1.0
    return low, high


MIXTURE_ALPHA = 0.05
EDGE = 1e-12


def score_of(elo: float) -> float:
    """Expected score at a logistic Elo difference."""
    return 1 / (1 + 10 ** (-elo / 400))


def elo_of(score: ArrayLike) -> Floats:
    """Logistic Elo difference at an expected score; infinite at 0 and 1."""
    s = np.asarray(score, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return 400 * (np.log10(s) - np.log10(1 - s))


def gsprt_llr(counts: ArrayLike, elo0: float, elo1: float, model: Model) -> Floats:
    """Log likelihood ratio of `elo1` against `elo0`.

    `counts` has shape `(..., 2n + 1)`: how many blocks of `n` games ended in each cell, worst first. Returns the
    shape `(...)`, so that all prefixes of a test are one call. No blocks at all give 0.

    Raises ValueError for counts that are none, for `elo0 >= elo1`, and for a normalised Elo beyond ±278 for
    single games, ±197 for pairs (see LARGEST_EFFECT).
    """
    cells = _cells(counts)
    _check_hypotheses(elo0, elo1, model, _games(cells.shape[-1]))
    total = cells.sum(axis=-1)
    rows, inverse = np.unique(cells.reshape(-1, cells.shape[-1]), axis=0, return_inverse=True)
    observed = np.maximum(rows, EMPTY_CELL)
    observed /= observed.sum(axis=-1, keepdims=True)
    estimate = _most_likely_score if model == "logistic" else _most_likely_effect
    p0, p1 = (estimate(observed, elo) for elo in (elo0, elo1))
    per_block = (observed * (np.log(p1) - np.log(p0))).sum(axis=-1)
    weight = np.maximum(rows, EMPTY_CELL).sum(axis=-1)
    llr = np.where(rows.sum(axis=-1) > 0, per_block * weight, 0.0)
    return np.asarray(llr[inverse.reshape(-1)].reshape(total.shape))


def elo_estimate(counts: ArrayLike, model: Model, confidence: float = 0.95) -> EloEstimate:
    """Elo of one series of blocks, `counts` of shape `(2n + 1,)`, with its normal interval.

    The interval is that of the mean block score, `mu ± z sigma / sqrt(N)`, carried over to Elo; after a sequential stop
    it is conditional on having stopped, and tends to be optimistic for the side that won.
    """
    cells = np.maximum(_cells(counts), EMPTY_CELL)
    if cells.ndim != 1:
        raise ValueError(f"one series of counts is expected, not an array of shape {cells.shape}")
    number, grid = cells.sum(), _grid(cells.shape[0])
    mean = float(cells @ grid / number)
    sigma = math.sqrt(float(cells @ (grid - mean) ** 2 / number))
    half = float(ndtri(0.5 + confidence / 2)) * sigma / math.sqrt(number)
    scores = np.array([mean, mean - half, mean + half])
    if model == "logistic":
        elos = elo_of(np.clip(scores, 0.0, 1.0))
    else:
        elos = (scores - 0.5) / (sigma * math.sqrt(_games(cells.shape[0]))) * ELO_PER_EFFECT
    return EloEstimate(*(float(x) for x in elos))


def expected_games(elo0: float, elo1: float, elo: float, alpha: float, beta: float) -> float:
    """Games that a test needs on average at a true normalised Elo, by Wald's approximation without overshoot.

    The LLR is a Brownian motion with variance `w = ((elo1 - elo0) / (800/ln 10))²` and drift
    `w (elo - (elo0 + elo1)/2) / (elo1 - elo0)` per game.
    """
    lower, upper = bounds(alpha, beta)
    variance = ((elo1 - elo0) / ELO_PER_EFFECT) ** 2
    drift = variance * (elo - (elo0 + elo1) / 2) / (elo1 - elo0)
    slope = 2 * drift / variance
    if abs(slope) < 1e-9:
        return -lower * upper / variance
    p_upper = math.expm1(-slope * lower) / (math.exp(-slope * lower) - math.exp(-slope * upper))
    return (p_upper * upper + (1 - p_upper) * lower) / drift


def _check_hypotheses(elo0: float, elo1: float, model: Model, games: int) -> None:
    if not elo0 < elo1:
        raise ValueError(f"elo0 must be below elo1, not {elo0} and {elo1}")
    limit = LARGEST_EFFECT * ELO_PER_EFFECT / math.sqrt(games)
    if model == "normalized" and max(abs(elo0), abs(elo1)) > limit:
        raise ValueError(f"normalized elo0 and elo1 must lie within ±{limit:.0f}, not {elo0} and {elo1}")


def _cells(counts: ArrayLike) -> Floats:
    cells = np.asarray(counts, dtype=np.float64)
    if cells.ndim == 0 or cells.shape[-1] not in (3, 5):
        raise ValueError(f"counts are (L, D, W) or (LL, LD, DD+WL, WD, WW), not of shape {cells.shape}")
    if (cells < 0).any() or not np.isfinite(cells).all():
        raise ValueError("counts must be finite and not negative")
    return cells


def _games(cells: int) -> int:
    return (cells - 1) // 2


def _grid(cells: int) -> Floats:
    return np.linspace(0.0, 1.0, cells)


def _most_likely_score(observed: Floats, elo: float) -> Floats:
    """The most likely distribution, per row of `observed` (m, cells), whose mean is the logistic score of `elo`."""
    return _tilt(observed, np.broadcast_to(_grid(observed.shape[1]) - score_of(elo), observed.shape))


def _most_likely_effect(observed: Floats, elo: float) -> Floats:
    """The most likely distribution, per row, with `(mean - 1/2) / sigma = t`: the fixed point of a linearised
    constraint.
    """
    grid = _grid(observed.shape[1])
    t = elo / ELO_PER_EFFECT * math.sqrt(_games(observed.shape[1]))
    p = np.full_like(observed, 1 / observed.shape[1])
    active = np.arange(len(observed))
    for _ in range(MAX_STEPS):
        current = p[active]
        mean = current @ grid
        sigma = np.sqrt((current * (grid - mean[:, None]) ** 2).sum(axis=1))[:, None]
        phi = grid - 0.5 - t * sigma * (1 + ((mean[:, None] - grid) / sigma) ** 2) / 2
        p[active] = _tilt(observed[active], phi)
        moved = np.abs(p[active] - current).max(axis=1)
        active = active[moved > 1e-8]
        if active.size == 0:
            return p
    raise ArithmeticError(f"the constrained estimate did not settle for {len(active)} count(s)")


def _tilt(observed: Floats, phi: Floats) -> Floats:
    """`p_i = q_i / (1 + theta phi_i)` with theta such that `sum_i p_i phi_i = 0`; rows of shape (m, cells).

    The sum falls from +inf to -inf between its two outermost poles. Newton's method on it, freed of these poles, and
    bisection where a step would leave the bracket.
    """
    first, last = phi.max(axis=1), phi.min(axis=1)
    poles = -1 / first, -1 / last
    low, high = poles
    theta = np.zeros(len(phi))
    for _ in range(MAX_NEWTON_STEPS):
        ratio = phi / (1 + theta[:, None] * phi)
        moment, slope = (observed * ratio).sum(axis=1), -(observed * ratio**2).sum(axis=1)
        low, high = np.where(moment > 0, theta, low), np.where(moment > 0, high, theta)
        a, b = 1 + theta * first, 1 + theta * last
        step = theta - moment * a * b / (slope * a * b + moment * (first * b + last * a))
        step = np.where((step > low) & (step < high), step, (low + high) / 2)
        room = np.minimum(step - poles[0], poles[1] - step)
        settled = np.abs(step - theta) <= 1e-8 * room
        theta = step
        if settled.all():
            break
    p = observed / (1 + theta[:, None] * phi)
    return np.asarray(p / p.sum(axis=1, keepdims=True))
