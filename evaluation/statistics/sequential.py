"""Sequential tests: the generalised SPRT on block scores, and a betting test on paired differences of returns.

A *block* is `n` games between two contestants from one opening with the sides rotated, so that the effects of seat and
opening cancel. Its score lies on the grid `a_i = i / 2n`, `i = 0 … 2n`. One game per block gives the trinomial cells
(L, D, W); two give the pentanomial cells (LL, LD, DD+WL, WD, WW). A pair of blocks has nine cells, the mean of k pairs
8 k + 1. Blocks are independent; the games of a block are not.

The expected score of the model `logistic` is `s(e) = 1 / (1 + 10^(-e/400))`. For `normalized`, the effect size of one
game is `(mu - 1/2) / sigma = e / (800 / ln 10)`, and that of a block of `n` games `sqrt(n)` times that. The formula of
the log likelihood ratio is in docs/statistics.md.

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
from scipy.special import betaln, ndtri

Model = Literal["logistic", "normalized"]
Floats = NDArray[np.float64]

ELO_PER_EFFECT = 800 / math.log(10)
"""Normalised Elo of an effect size of one standard deviation per game."""

EMPTY_CELL = 1e-3
"""Count of an empty cell, so that every distribution has full support."""

LARGEST_EFFECT = 0.8
"""Largest normalised hypothesis, in standard deviations of a block. Beyond one, the constrained estimate
need not exist; near one, it converges slowly."""

MAX_STEPS = 2000
"""Iterations of the constrained estimate. A dozen are usual; a few blocks with large effects need hundreds."""

TOLERANCE = 1e-8
"""Convergence of the constrained estimate: the change of a probability, and of a tilt relative to its nearer pole."""

MAX_NEWTON_STEPS = 100
"""Iterations of one tilt. Six are usual; empty cells need dozens of bisections."""


@dataclass(frozen=True, slots=True)
class EloEstimate:
    """Elo difference of the first contestant to the second, with the bounds of a two-sided interval."""

    elo: float
    low: float
    high: float

    @property
    def interval(self) -> tuple[float | None, float | None]:
        """The bounds, with None for infinite ones."""
        low, high = (bound if math.isfinite(bound) else None for bound in (self.low, self.high))
        return low, high


def bounds(alpha: float, beta: float) -> tuple[float, float]:
    """Wald's bounds of the log likelihood ratio.

    Args:
        alpha: Probability of accepting H1 at `elo0`.
        beta: Probability of accepting H0 at `elo1`.

    Returns:
        `(lower, upper)`: H0 is accepted at or below `ln(beta / (1 - alpha))`, H1 at or above `ln((1 - beta) / alpha)`.

    Raises:
        ValueError: Unless both are positive and their sum is below 1.
    """
    if not (alpha > 0 and beta > 0 and alpha + beta < 1):
        raise ValueError(f"alpha and beta must be positive with a sum below 1, not {alpha} and {beta}")
    return math.log(beta / (1 - alpha)), math.log((1 - beta) / alpha)


def overshoot(curve: ArrayLike) -> tuple[float, float]:
    """Expected overshoot of the log likelihood ratio beyond its bounds.

    A test that stops at Wald's bounds errs less often than allowed, because it stops beyond them. With the bounds moved
    inwards (`lower + first`, `upper - second`) it uses its error probabilities and stops earlier. The estimate is
    `E h² / 2 E h` over the ladder heights h of the curve, its steps to a new extreme (Siegmund, equation 8.49).

    Args:
        curve: LLR after each block, shape `(N,)`, as `gsprt_llr` returns for all prefixes.

    Returns:
        Overshoot at the lower and at the upper bound, both >= 0.
    """
    llr = np.concatenate([[0.0], np.asarray(curve, dtype=np.float64)])
    return _ladder(np.minimum.accumulate(llr)), _ladder(np.maximum.accumulate(llr))


def _ladder(extremes: Floats) -> float:
    heights = np.abs(np.diff(extremes))
    return float((heights**2).sum() / (2 * heights.sum())) if heights.any() else 0.0


@dataclass(frozen=True, slots=True)
class BettingTest:
    """Anytime-valid test of the mean of independent differences `d` within ±bound, for any distribution.

    H0: the mean is at most `low`. H1: the mean is at least `high`. A bettor stakes part of its wealth on each
    difference before observing it, at odds that are fair under the hypothesis to refute. Under that hypothesis, the
    probability that the wealth ever reaches `1 / a` is at most `a` (Ville's inequality), so the test may stop at any
    time. It suits few blocks and returns without a known likelihood.

    The bet on `x = (1 + d / bound) / 2` against a mean of `m` is `clip((mu - m) / (s² + (mu - m)²), 0, c / m)`, with
    the mean and variance of all earlier observations (the approximate GRAPA bet of Waudby-Smith and Ramdas, section
    B.3).

    Args:
        bound: Largest absolute difference, in the unit of returns.
        alpha: Probability of accepting H1 under H0.
        beta: Probability of accepting H0 under H1.
        low: Mean under H0, in the unit of returns.
        high: Mean under H1, in the unit of returns.

    Raises:
        ValueError: For probabilities outside (0, 1), or hypotheses outside ±bound.
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
        """Critical log wealths: `ln(1 / beta)` accepts H0, `ln(1 / alpha)` accepts H1."""
        return math.log(1 / self.beta), math.log(1 / self.alpha)

    def curves(self, differences: ArrayLike) -> tuple[Floats, Floats]:
        """Log wealth of the bettors against H1 and against H0 after each difference.

        Args:
            differences: Differences of returns, shape `(..., N)`.

        Returns:
            Two float64 arrays of the same shape: against H1, against H0.

        Raises:
            ValueError: For a difference beyond ±bound.
        """
        x = (1 + np.asarray(differences, dtype=np.float64) / self.bound) / 2
        if not ((x >= 0) & (x <= 1)).all():
            raise ValueError(f"differences must lie within ±{self.bound:g}")
        low, high = ((1 + edge / self.bound) / 2 for edge in (self.low, self.high))
        return _log_wealth(1 - x, 1 - high), _log_wealth(x, low)

    def decide(self, differences: ArrayLike) -> tuple[Literal["H0", "H1"] | None, int]:
        """Decide one series.

        Args:
            differences: Differences of returns, shape `(N,)`.

        Returns:
            The accepted hypothesis and the number of differences until the decision; `(None, N)` while undecided.
        """
        curves = np.stack(self.curves(differences))
        crossed = np.flatnonzero((curves >= np.array(self.bounds)[:, None]).any(axis=0))
        if not crossed.size:
            return None, curves.shape[1]
        first = int(crossed[0])
        return ("H1" if curves[1, first] >= self.bounds[1] else "H0"), first + 1


BOLDNESS = 0.75
"""Largest share of the wealth that a bet can lose."""


def _log_wealth(x: Floats, mean: float) -> Floats:
    """Log wealth of a bettor against H0: mean of x in [0, 1] ≤ `mean`, `sum ln(1 + bet (x - mean))`."""
    sample_sizes = np.arange(1, x.shape[-1] + 1)
    before = np.cumsum(x, axis=-1) - x
    guess = (0.5 + before) / sample_sizes
    deviations = (x - (0.5 + np.cumsum(x, axis=-1)) / (sample_sizes + 1)) ** 2
    variance = (0.25 + np.cumsum(deviations, axis=-1) - deviations) / sample_sizes
    edge = guess - mean
    bet = np.clip(edge / (variance + edge**2), 0.0, BOLDNESS / mean)
    return np.asarray(np.cumsum(np.log1p(bet * (x - mean)), axis=-1))


def bernoulli_interval(successes: int, trials: int, alpha: float = 0.05, best_at: float = 100.0) -> tuple[float, float]:
    """Confidence interval of a probability that is valid at all times simultaneously with probability `1 - alpha`.

    It contains every p whose likelihood is more than `alpha` times that of a mixture of Bernoulli likelihoods,
    Beta-distributed around p (Howard et al., proposition 7).

    Args:
        successes: Number of successes.
        trials: Number of trials, at least 1.
        alpha: Error probability over all times.
        best_at: Number of trials at which the interval is about as narrow as possible.

    Returns:
        Lower and upper bound in [0, 1].

    Raises:
        ValueError: For impossible counts.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"expected 0 <= successes <= trials and at least one trial, got {successes} of {trials}")
    failures = trials - successes

    def refuted(p: float) -> float:
        variance = p * (1 - p)
        scale = 2 * math.log(1 / MIXTURE_ALPHA)
        rho = best_at * variance / (scale + math.log(1 + scale))
        r = max(rho - variance, 1e-3 * variance)
        a, b = r / (1 - p), r / p
        mixture = betaln(a + successes, b + failures) - betaln(a, b)
        return float(mixture - successes * math.log(p) - failures * math.log(1 - p) + math.log(alpha))

    from scipy.optimize import brentq  # a third of the start-up time of commands that only read results

    estimate = min(max(successes / trials, EDGE), 1 - EDGE)
    low = brentq(refuted, EDGE, estimate) if successes and refuted(EDGE) > 0 else 0.0
    high = brentq(refuted, estimate, 1 - EDGE) if failures and refuted(1 - EDGE) > 0 else 1.0
    return low, high


MIXTURE_ALPHA = 0.05
EDGE = 1e-12


def score_of(elo: float) -> float:
    """Expected score in (0, 1) at a logistic Elo difference."""
    return 1 / (1 + 10 ** (-elo / 400))


def elo_of(score: ArrayLike) -> Floats:
    """Logistic Elo difference at an expected score.

    Args:
        score: Scores in [0, 1], any shape.

    Returns:
        float64 array of the same shape; infinite at 0 and 1.
    """
    s = np.asarray(score, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return 400 * (np.log10(s) - np.log10(1 - s))


def gsprt_llr(counts: ArrayLike, elo0: float, elo1: float, model: Model) -> Floats:
    """Log likelihood ratio of `elo1` against `elo0`.

    Args:
        counts: Blocks per cell, worst first, shape `(..., 2n + 1)` with `n` games per block. All prefixes of a test can
            be passed in one call.
        elo0: Elo difference under H0.
        elo1: Elo difference under H1.
        model: Unit of `elo0` and `elo1`.

    Returns:
        float64 array of shape `(...)`; 0 without blocks.

    Raises:
        ValueError: For invalid counts, for `elo0 >= elo1`, and for a normalised Elo beyond ±278 for single games or
            ±197 for pairs (see LARGEST_EFFECT).
    """
    cells = _cells(counts)
    if not elo0 < elo1:
        raise ValueError(f"elo0 must be below elo1, not {elo0} and {elo1}")
    limit = LARGEST_EFFECT * ELO_PER_EFFECT / math.sqrt(_games(cells.shape[-1]))
    if model == "normalized" and max(abs(elo0), abs(elo1)) > limit:
        raise ValueError(f"normalized elo0 and elo1 must lie within ±{limit:.0f}, not {elo0} and {elo1}")
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


def elo_estimate(counts: ArrayLike, confidence: float = 0.95) -> EloEstimate:
    """Difference in logistic Elo estimated from one series of blocks, with a normal interval.

    The interval is that of the mean block score, `mu ± z sigma / sqrt(N)`, converted to Elo. After a sequential stop it
    is conditional on having stopped, and optimistic for the winner.

    Args:
        counts: Blocks per cell, worst first, shape `(2n + 1,)`.
        confidence: Coverage of the interval.

    Raises:
        ValueError: For invalid counts.
    """
    cells = _cells(counts)
    mean, sigma = _moments(cells)
    number = np.maximum(cells, EMPTY_CELL).sum()
    half = float(ndtri(0.5 + confidence / 2)) * sigma / math.sqrt(number)
    elos = elo_of(np.clip([mean, mean - half, mean + half], 0.0, 1.0))
    return EloEstimate(*(float(x) for x in elos))


def score_at(elo: float, counts: ArrayLike, model: Model) -> float:
    """Expected score of a block at an Elo difference.

    Args:
        elo: Elo difference in the unit of `model`.
        counts: Blocks per cell, worst first, shape `(2n + 1,)`, whose deviation `normalized` assumes.
        model: Unit of `elo`.

    Returns:
        A score in [0, 1].

    Raises:
        ValueError: For invalid counts.
    """
    if model == "logistic":
        return score_of(elo)
    cells = _cells(counts)
    effect = elo / ELO_PER_EFFECT * math.sqrt(_games(cells.shape[-1]))
    return min(max(0.5 + effect * _moments(cells)[1], 0.0), 1.0)


def _moments(cells: Floats) -> tuple[float, float]:
    """Mean and standard deviation of the block scores of one series."""
    if cells.ndim != 1:
        raise ValueError(f"expected one series of counts, got an array of shape {cells.shape}")
    shares, grid = np.maximum(cells, EMPTY_CELL), _grid(cells.shape[0])
    shares = shares / shares.sum()
    mean = float(shares @ grid)
    return mean, math.sqrt(float(shares @ (grid - mean) ** 2))


def expected_games(elo0: float, elo1: float, elo: float, alpha: float, beta: float) -> float:
    """Average number of games of a test, by Wald's approximation without overshoot.

    The LLR is a Brownian motion with variance `w = ((elo1 - elo0) / (800/ln 10))²` and drift
    `w (elo - (elo0 + elo1)/2) / (elo1 - elo0)` per game.

    Args:
        elo0: Normalised Elo under H0.
        elo1: Normalised Elo under H1.
        elo: True normalised Elo.
        alpha: Probability of accepting H1 under H0.
        beta: Probability of accepting H0 under H1.
    """
    lower, upper = bounds(alpha, beta)
    variance = ((elo1 - elo0) / ELO_PER_EFFECT) ** 2
    drift = variance * (elo - (elo0 + elo1) / 2) / (elo1 - elo0)
    slope = 2 * drift / variance
    if abs(slope) < 1e-9:
        return -lower * upper / variance
    p_upper = math.expm1(-slope * lower) / (math.exp(-slope * lower) - math.exp(-slope * upper))
    return (p_upper * upper + (1 - p_upper) * lower) / drift


def _cells(counts: ArrayLike) -> Floats:
    cells = np.asarray(counts, dtype=np.float64)
    if cells.ndim == 0 or cells.shape[-1] < 3 or cells.shape[-1] % 2 == 0:
        raise ValueError(f"counts must have 2 n + 1 cells, for n >= 1 games per block, got shape {cells.shape}")
    if (cells < 0).any() or not np.isfinite(cells).all():
        raise ValueError("counts must be finite and non-negative")
    return cells


def _games(cells: int) -> int:
    return (cells - 1) // 2


def _grid(cells: int) -> Floats:
    return np.linspace(0.0, 1.0, cells)


def _most_likely_score(observed: Floats, elo: float) -> Floats:
    """Maximum likelihood distribution per row (m, cells) whose mean is the logistic score of `elo`."""
    return _tilt(observed, np.broadcast_to(_grid(observed.shape[1]) - score_of(elo), observed.shape))


def _most_likely_effect(observed: Floats, elo: float) -> Floats:
    """Maximum likelihood distribution per row with `(mean - 1/2) / sigma = t`, by fixed-point iteration."""
    grid = _grid(observed.shape[1])
    t = elo / ELO_PER_EFFECT * math.sqrt(_games(observed.shape[1]))
    p = np.full_like(observed, 1 / observed.shape[1])
    active = np.arange(len(observed))
    for _ in range(MAX_STEPS):
        current = p[active]
        mean = (current * grid).sum(axis=1)  # unlike a matrix product, independent of the number of rows
        sigma = np.sqrt((current * (grid - mean[:, None]) ** 2).sum(axis=1))[:, None]
        phi = grid - 0.5 - t * sigma * (1 + ((mean[:, None] - grid) / sigma) ** 2) / 2
        p[active] = _tilt(observed[active], phi)
        moved = np.abs(p[active] - current).max(axis=1)
        active = active[moved > TOLERANCE]
        if active.size == 0:
            return p
    raise ArithmeticError(f"the constrained estimate did not converge for {len(active)} count(s)")


def _tilt(observed: Floats, phi: Floats) -> Floats:
    """`p_i = q_i / (1 + theta phi_i)` with theta such that `sum_i p_i phi_i = 0`, for rows of shape (m, cells).

    The sum falls from +inf to -inf between its two outermost poles. Newton's method runs on the sum without these
    poles, and falls back to bisection where a step would leave the bracket. The result of a row does not depend on the
    other rows, so that a later block does not change the LLR of an earlier one.
    """
    first, last = phi.max(axis=1), phi.min(axis=1)
    poles = -1 / first, -1 / last
    low, high = poles
    theta, settled = np.zeros(len(phi)), np.zeros(len(phi), dtype=bool)
    for _ in range(MAX_NEWTON_STEPS):
        ratio = phi / (1 + theta[:, None] * phi)
        moment, slope = (observed * ratio).sum(axis=1), -(observed * ratio**2).sum(axis=1)
        low, high = np.where(moment > 0, theta, low), np.where(moment > 0, high, theta)
        a, b = 1 + theta * first, 1 + theta * last
        with np.errstate(divide="ignore", invalid="ignore"):  # then the step is a bisection
            step = theta - moment * a * b / (slope * a * b + moment * (first * b + last * a))
        step = np.where((step > low) & (step < high), step, (low + high) / 2)
        room = np.minimum(step - poles[0], poles[1] - step)
        is_close = np.abs(step - theta) <= TOLERANCE * room
        theta = np.where(settled, theta, step)
        settled |= is_close
        if settled.all():
            break
    p = observed / (1 + theta[:, None] * phi)
    return np.asarray(p / p.sum(axis=1, keepdims=True))
