"""Sequential tests: log-likelihood ratios, their bounds and estimates, intervals at all times, and betting."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from evaluation.statistics.sequential import (
    ELO_PER_EFFECT,
    BettingTest,
    Model,
    bernoulli_interval,
    bounds,
    elo_estimate,
    elo_of,
    expected_games,
    gsprt_llr,
    overshoot,
    score_of,
)

MODELS: tuple[Model, ...] = ("logistic", "normalized")


Counts = tuple[int, ...]


trinomial = st.tuples(*[st.integers(0, 400)] * 3)


pentanomial = st.tuples(*[st.integers(0, 400)] * 5)


counts = st.one_of(trinomial, pentanomial)


few_examples = settings(max_examples=40, deadline=None)


hypotheses = st.tuples(st.floats(-100, 100), st.floats(1, 60)).map(lambda pair: (pair[0], pair[0] + pair[1]))


def six_cells(ll: int, ld: int, wl: int, dd: int, wd: int, ww: int) -> Counts:
    """The cells of fastchess, which separates WL and DD."""
    return ll, ld, wl + dd, wd, ww


def test_llrs_and_estimates_equal_those_of_fastchess() -> None:
    """app/tests/sprt_test.cpp, printed with two decimals, and elo_test.cpp: half the width of 95 % intervals."""
    rows: list[tuple[Counts, float, float, Model, float]] = [
        ((36027, 68692, 36433), 0, 2, "normalized", 0.92),
        ((10650, 20431, 10871), -1.75, 0.25, "normalized", 2.30),
        ((21184, 40708, 21404), 0.5, 2.5, "logistic", -1.57),
        ((57030, 106593, 57433), 0, 2, "logistic", -2.59),
        (six_cells(365, 16618, 36029, 200, 16974, 390), 0, 2, "normalized", 2.25),
        (six_cells(127, 4883, 10311, 401, 5150, 104), -1.75, 0.25, "normalized", 3.01),
        (six_cells(223, 9863, 20279, 1000, 10037, 246), 0.5, 2.5, "logistic", -3.07),
        (six_cells(871, 26175, 55003, 980, 26678, 821), 0, 2, "logistic", -4.98),
    ]
    for observed, elo0, elo1, model, llr in rows:
        assert gsprt_llr(observed, elo0, elo1, model) == pytest.approx(llr, abs=5e-3)
    assert gsprt_llr((13, 37, 50, 25, 3), 0, 4, "normalized") == pytest.approx(-0.54912, abs=1e-5)
    for observed, elo, half in (
        ((96, 111, 136), 40.70, 30.43),
        (six_cells(34, 54, 31, 32, 64, 75), 55.58, 27.65),
        (six_cells(332, 433, 457, 41, 333, 334), -8.64, 10.33),
    ):
        estimate = elo_estimate(observed)
        assert estimate.elo == pytest.approx(elo, abs=6e-3)
        assert (estimate.high - estimate.low) / 2 == pytest.approx(half, abs=6e-3)


def test_bounds_and_expected_games() -> None:
    """Wald's approximation at alpha = beta = 0.05."""
    assert bounds(0.05, 0.05) == pytest.approx((-2.94444, 2.94444), abs=1e-5)
    assert bounds(0.01, 0.2) == pytest.approx((math.log(0.2 / 0.99), math.log(0.8 / 0.01)))
    for elo1, ends, middle in ((35, 522, 854), (20, 1599, 2616)):
        for elo, games in ((0, ends), (elo1, ends), (elo1 / 2, middle)):
            assert expected_games(0, elo1, elo, 0.05, 0.05) == pytest.approx(games, abs=0.5)


def test_invalid_arguments_are_rejected() -> None:
    for alpha, beta in ((0, 0.05), (0.05, 0), (0.5, 0.5), (-0.1, 0.1)):
        with pytest.raises(ValueError, match="alpha and beta"):
            bounds(alpha, beta)
    for observed in ((1, 2), (1, 2, 3, 4), (1, -2, 3), (1, 2, math.nan), 3):
        with pytest.raises(ValueError, match="counts"):
            gsprt_llr(observed, 0, 30, "normalized")
    for elo0, elo1 in ((30, 0), (0, 0), (0, 200), (-200, 0)):
        with pytest.raises(ValueError, match="elo0"):
            gsprt_llr((1, 2, 3, 4, 5), elo0, elo1, "normalized")
    for successes, trials in ((-1, 5), (6, 5), (0, 0)):
        with pytest.raises(ValueError, match="successes"):
            bernoulli_interval(successes, trials)
    low_above_high = {"low": 0.2, "high": 0.1}
    for arguments in ({"bound": 0.0}, {"alpha": 0.0}, {"beta": 1.0}, {"low": 1.0}, low_above_high, {"high": 2.0}):
        with pytest.raises(ValueError, match=r"bound|low"):
            BettingTest(**({"bound": 1.0, "alpha": 0.05, "beta": 0.05} | arguments))
    with pytest.raises(ValueError, match="within ±1"):
        BettingTest(1.0, alpha=0.05, beta=0.05).curves([0.5, 1.5])


@few_examples
@given(st.floats(-400, 400))
def test_elo_and_score_are_inverse(elo: float) -> None:
    assert elo_of(score_of(elo)) == pytest.approx(elo, abs=1e-6)


@few_examples
@given(counts, hypotheses, st.sampled_from(MODELS))
def test_llr_is_antisymmetric(observed: Counts, elos: tuple[float, float], model: Model) -> None:
    """From the opponent's side, the same games are the opposite evidence."""
    llr = gsprt_llr(observed, elos[0], elos[1], model)
    mirrored = gsprt_llr(observed[::-1], -elos[1], -elos[0], model)
    assert llr == pytest.approx(-mirrored, abs=1e-5)


@few_examples
@given(st.tuples(*[st.integers(1, 400)] * 5), st.integers(0, 3), hypotheses)
def test_a_better_block_increases_the_logistic_llr(observed: Counts, cell: int, elos: tuple[float, float]) -> None:
    one = np.eye(5, dtype=int)
    worse, better = (gsprt_llr(observed + one[i], *elos, "logistic") for i in (cell, cell + 1))
    assert better > worse


@few_examples
@given(st.lists(st.integers(0, 4), min_size=1, max_size=25), hypotheses, st.sampled_from(MODELS))
def test_llrs_of_prefixes_are_computed_at_once(cells: list[int], elos: tuple[float, float], model: Model) -> None:
    prefixes = np.eye(5)[cells].cumsum(axis=0)
    together = gsprt_llr(prefixes, *elos, model)
    assert together == pytest.approx([float(gsprt_llr(row, *elos, model)) for row in prefixes], abs=1e-7)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("observed", [(13, 37, 50, 25, 3), (30, 2, 100, 4, 45), (1, 5, 9), (9, 1, 2)])
def test_constrained_estimates_maximize_the_likelihood(observed: Counts, model: Model) -> None:
    """Compared with a general-purpose optimizer."""
    elo0, elo1 = -40.0, 90.0
    total = [_best_likelihood(observed, elo, model) for elo in (elo0, elo1)]
    assert gsprt_llr(observed, elo0, elo1, model) == pytest.approx(total[1] - total[0], abs=1e-5)


def _best_likelihood(observed: Counts, elo: float, model: Model) -> float:
    n = np.array(observed, dtype=float)
    grid = np.linspace(0, 1, len(n))
    effect = elo / ELO_PER_EFFECT * math.sqrt((len(n) - 1) / 2)

    def constraint(p: np.ndarray) -> float:
        mean = p @ grid
        if model == "logistic":
            return float(mean - score_of(elo))
        return float(mean - 0.5 - effect * math.sqrt(p @ (grid - mean) ** 2))

    optimum = minimize(
        lambda p: -(n @ np.log(p)),
        np.full(len(n), 1 / len(n)),
        jac=lambda p: -n / p,
        bounds=[(1e-9, 1)] * len(n),
        constraints=[{"type": "eq", "fun": constraint}, {"type": "eq", "fun": lambda p: p.sum() - 1}],
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-13},
    )
    return -float(optimum.fun)


@few_examples
@given(counts, st.sampled_from([-190.0, -100.0, 100.0, 190.0]))
def test_extreme_counts_and_hypotheses_have_a_finite_llr(observed: Counts, elo: float) -> None:
    elo0, elo1 = sorted((0.0, elo))
    assert math.isfinite(gsprt_llr(observed, elo0, elo1, "normalized"))
    assert float(gsprt_llr((0, 0, 0, 0, 0), 0, 30, "normalized")) == pytest.approx(0.0, abs=1e-12), "no blocks"


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=60))
def test_overshoot_is_half_the_weighted_step_to_a_new_extreme(steps: list[float]) -> None:
    curve = np.cumsum(steps)
    low, high = overshoot(curve)
    heights, best = [], 0.0
    for value in curve:
        if value > best:
            heights.append(value - best)
            best = value
    expected = sum(h * h for h in heights) / (2 * sum(heights)) if heights else 0.0
    assert high == pytest.approx(expected)
    assert overshoot(-curve) == pytest.approx((high, low))


def test_the_overshoot_correction_gives_the_nominal_error_rate() -> None:
    """A random walk with steps of a fifth of the bound: without correction the error rate is too low."""
    rng, lower, upper = np.random.default_rng(0), *bounds(0.05, 0.05)
    effect = 0.6
    steps = effect * (rng.normal(0, 1, (4000, 400)) - effect / 2)  # log likelihood ratio of a shift, under H0
    curves = steps.cumsum(axis=1)
    plain = [_ends(curve, lower, upper) for curve in curves]
    corrected = []
    for curve in curves[:1500]:
        first = next(
            n
            for n in range(1, 401)
            for low, high in [overshoot(curve[:n])]
            if not lower + low < curve[n - 1] < upper - high
        )
        corrected.append(curve[first - 1] > 0)
    assert np.mean(plain) < 0.045
    assert 0.036 <= np.mean(corrected) <= 0.066


def _ends(curve: np.ndarray, lower: float, upper: float) -> bool:
    return bool(curve[np.flatnonzero((curve <= lower) | (curve >= upper))[0]] > 0)


@given(st.integers(1, 500), st.data())
def test_the_interval_contains_the_estimate_and_is_symmetric(trials: int, data: st.DataObject) -> None:
    """gostevehoward/confseq: bernoulli_confidence_interval(700, 1000, .05, 100)."""
    assert bernoulli_interval(700, 1000, 0.05, 100) == pytest.approx((0.651629, 0.745949), abs=1e-6)
    successes = data.draw(st.integers(0, trials))
    low, high = bernoulli_interval(successes, trials)
    assert 0 <= low <= successes / trials <= high <= 1
    assert bernoulli_interval(trials - successes, trials) == pytest.approx((1 - high, 1 - low), abs=1e-6)


def test_the_interval_is_valid_at_all_times() -> None:
    rng, missed = np.random.default_rng(1), 0
    for _ in range(200):
        successes = np.cumsum(rng.random(300) < 0.9)
        looks = (bernoulli_interval(int(successes[n - 1]), n) for n in range(5, 301, 5))
        missed += any(not low <= 0.9 <= high for low, high in looks)
    assert missed <= 17, "5 % of 200, plus 2.5 standard deviations"


DIFFERENCES = {
    "normal": lambda rng, size: np.clip(rng.normal(0, 0.3, size), -1, 1),
    "rare and large": lambda rng, size: rng.choice([-1.0, 0.0, 1.0], size, p=[0.02, 0.96, 0.02]),
    "skewed": lambda rng, size: np.where(rng.random(size) < 0.9, 0.1, -0.9),
    "two points": lambda rng, size: rng.choice([-1.0, 1.0], size),
}


def test_a_bet_rarely_wins_under_the_null_hypothesis() -> None:
    """Ville's inequality: at most a fraction alpha of all series ever reaches the bound, at any number of looks."""
    for kind, draw in DIFFERENCES.items():
        series = draw(np.random.default_rng(0), (2000, 800))
        assert abs(series.mean()) < 0.01
        test = BettingTest(1.0, alpha=0.05, beta=0.05)
        for curves, bound in zip(test.curves(series), test.bounds, strict=True):
            assert (curves.max(axis=1) >= bound).mean() <= 0.0622, f"{kind}: 5 %, plus 2.5 standard deviations"


def test_a_bet_wins_under_the_alternative() -> None:
    rng = np.random.default_rng(0)
    better = np.clip(rng.normal(0.1, 0.3, (300, 800)), -1, 1)
    test = BettingTest(1.0, alpha=0.05, beta=0.05)
    ends = [test.decide(series) for series in better]
    assert all(outcome == "H1" for outcome, _ in ends)
    assert np.median([number for _, number in ends]) < 120, "a fixed-sample test of the same power takes 78"


def test_losses_are_no_evidence_of_an_improvement() -> None:
    """The wealth against H0 does not grow with them: a bettor never bets on the hypothesis that it tests."""
    test, losses = BettingTest(1.0, alpha=0.05, beta=0.05), np.full(40, -1.0)
    np.testing.assert_allclose(test.curves(losses)[1], 0.0, atol=1e-12)
    assert test.decide(losses)[0] == "H0"


def test_with_separated_hypotheses_h0_can_be_accepted() -> None:
    rng, test = np.random.default_rng(0), BettingTest(10.0, alpha=0.05, beta=0.05, low=0.0, high=1.0)
    equal = rng.normal(0, 2, (200, 2000)).clip(-10, 10)
    outcomes = [test.decide(series)[0] for series in equal]
    assert outcomes.count("H0") >= 190 - 1
    assert outcomes.count("H1") <= 18


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=40), st.integers(1, 39))
def test_a_bet_does_not_depend_on_later_differences(differences: list[float], cut: int) -> None:
    test = BettingTest(1.0, alpha=0.05, beta=0.05)
    complete, part = test.curves(differences), test.curves(differences[:cut])
    for long, short in zip(complete, part, strict=True):
        assert long[: len(short)] == pytest.approx(short)
        assert np.isfinite(long).all(), "a bet never loses everything"


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=40))
def test_the_two_sides_of_a_bet_are_symmetric(differences: list[float]) -> None:
    test = BettingTest(5.0, alpha=0.05, beta=0.05)
    down, up = test.curves(differences)
    mirrored = test.curves([-d for d in differences])
    assert (down, up) == (pytest.approx(mirrored[1]), pytest.approx(mirrored[0]))
