import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.opponents import LeagueOpponentsConfig, Sampling, Weighting
from training.algorithms.opponent_distribution import opponent_distribution, systematic_counts

NAN = float("nan")
ROCK_PAPER_SCISSORS = [[0.5, 0.0, 1.0], [1.0, 0.5, 0.0], [0.0, 1.0, 0.5]]
SAMPLINGS: tuple[Sampling, ...] = ("latest", "uniform", "pfsp", "nash", "alpha_rank")


def distribution(
    scores: list[float],
    payoff: object = None,
    *,
    sampling: Sampling = "pfsp",
    weighting: Weighting = "power",
    forgotten: float = 0.0,
) -> np.ndarray:
    config = LeagueOpponentsConfig(sampling=sampling, weighting=weighting, forgotten=forgotten)
    unknown = np.full((len(scores), len(scores)), NAN)
    return opponent_distribution(config, scores, unknown if payoff is None else np.asarray(payoff))


def test_pfsp_prefers_opponents_that_win(subtests: pytest.Subtests) -> None:
    rows: list[tuple[Weighting, list[float], list[float]]] = [
        ("power", [1.0, 1.0], [1 / 2, 1 / 2]),
        ("variance", [1.0, 0.0], [1 / 2, 1 / 2]),
        ("linear_capped", [1.0, 1.0, 1.0], [1 / 3, 1 / 3, 1 / 3]),
        ("power", [0.0, 0.0], [1 / 2, 1 / 2]),
        ("variance", [0.0, 0.0], [1 / 2, 1 / 2]),
        ("linear_capped", [0.0, 0.0], [1 / 2, 1 / 2]),
        ("power", [0.0, 0.5, 1.0], [4 / 5, 1 / 5, 0.0]),
        ("variance", [0.5, 0.75, 1.0], [4 / 7, 3 / 7, 0.0]),
        ("linear_capped", [0.0, 0.25, 0.75], [2 / 5, 2 / 5, 1 / 5]),
        ("power", [NAN, NAN], [1 / 2, 1 / 2]),
        ("power", [1.0, NAN], [0.0, 1.0]),
        ("power", [0.0, NAN], [4 / 5, 1 / 5]),
    ]
    for weighting, scores, expected in rows:
        with subtests.test(weighting, scores=scores):
            np.testing.assert_allclose(distribution(scores, weighting=weighting), expected)


def test_a_higher_power_prefers_stronger_opponents() -> None:
    config = LeagueOpponentsConfig(power=3.0, forgotten=0.0)
    np.testing.assert_allclose(opponent_distribution(config, [0.0, 0.5], np.full((2, 2), NAN)), [8 / 9, 1 / 9])


def test_forgotten_opponents_have_a_share_of_their_own() -> None:
    shares = distribution([1.0, 0.6, 0.69, 0.7], sampling="latest", forgotten=0.2)
    np.testing.assert_allclose(shares, [0.0, 0.1, 0.1, 0.8])
    np.testing.assert_allclose(distribution([1.0, 0.7], sampling="latest", forgotten=0.2), [0.0, 1.0])


@pytest.mark.parametrize("sampling", ["nash", "alpha_rank"])
def test_the_meta_strategy_of_the_payoff_matrix(sampling: Sampling) -> None:
    cycle = distribution([0.5, 0.5, 0.5], ROCK_PAPER_SCISSORS, sampling=sampling)
    np.testing.assert_allclose(cycle, [1 / 3, 1 / 3, 1 / 3], atol=1e-6)
    best = distribution([0.5, 0.5], [[0.5, 0.0], [1.0, 0.5]], sampling=sampling)
    np.testing.assert_allclose(best, [0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(distribution([0.5, 0.5], sampling=sampling), [0.5, 0.5], atol=1e-6)


@given(
    scores=st.lists(st.floats(0, 1) | st.just(NAN), max_size=6),
    sampling=st.sampled_from(SAMPLINGS),
    weighting=st.sampled_from(["power", "variance", "linear_capped"]),
    forgotten=st.floats(0, 1),
    data=st.data(),
)
@settings(max_examples=60)
def test_probabilities_are_valid(
    scores: list[float], sampling: Sampling, weighting: Weighting, forgotten: float, data: st.DataObject
) -> None:
    n = len(scores)
    row = st.lists(st.sampled_from([0.0, 0.25, 0.5, 1.0, NAN]), min_size=n, max_size=n)
    payoff = data.draw(st.lists(row, min_size=n, max_size=n))
    shares = distribution(scores, payoff, sampling=sampling, weighting=weighting, forgotten=forgotten)
    assert shares.shape == (n,)
    assert (shares >= 0).all()
    np.testing.assert_allclose(shares.sum(), 1.0 if n else 0.0)


@given(weights=st.lists(st.integers(0, 9), min_size=1, max_size=6).filter(any), draws=st.integers(1, 8))
def test_systematic_counts_differ_from_their_expectation_by_less_than_one(weights: list[int], draws: int) -> None:
    p = np.array(weights) / sum(weights)
    counts = systematic_counts(p, draws, np.random.default_rng(0))
    assert counts.sum() == draws
    assert (np.abs(counts - draws * p) < 1 + 1e-9).all()
    assert not counts[p == 0].any()
