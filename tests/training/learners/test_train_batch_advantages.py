import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from training.learners.train_batch import generalized_advantages

GAMMA, LAMBDA = 0.9, 0.8


def by_definition(rewards: list[float], values: list[float], bootstrap: float) -> list[float]:
    """A_t = Σ_k (γλ)^k δ_{t+k} over one chunk (equation 11 of the paper), as a sum per step."""
    following = [*values[1:], bootstrap]
    deltas = [r + GAMMA * n - v for r, v, n in zip(rewards, values, following, strict=True)]
    return [sum((GAMMA * LAMBDA) ** k * delta for k, delta in enumerate(deltas[t:])) for t in range(len(deltas))]


def by_recursion(rewards: NDArray, values: NDArray, next_values: NDArray, lasts: NDArray, decay: float) -> list[float]:
    """A_t = δ_t + γλ A_{t+1} (equation 16), step by step."""
    advantages = []
    following = 0.0
    for reward, value, next_value, last in zip(
        *(column[::-1].tolist() for column in (rewards, values, next_values, lasts)), strict=True
    ):
        following = reward + GAMMA * next_value - value + (0.0 if last else decay * following)
        advantages.append(following)
    return advantages[::-1]


numbers = st.floats(-10, 10, width=32)
chunks = st.lists(
    st.tuples(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=6), numbers), min_size=1, max_size=5
)


@given(chunks)
@settings(deadline=None)
def test_advantages_equal_the_definition_for_consecutive_chunks(
    chunks: list[tuple[list[tuple[float, float]], float]],
) -> None:
    expected, rewards, values, next_values, lasts = [], [], [], [], []
    for steps, bootstrap in chunks:
        rewarded, valued = [r for r, _ in steps], [v for _, v in steps]
        expected += by_definition(rewarded, valued, bootstrap)
        rewards += rewarded
        values += valued
        next_values += [*valued[1:], bootstrap]
        lasts += [False] * (len(steps) - 1) + [True]
    found = generalized_advantages(
        np.array(rewards), np.array(values), np.array(next_values), np.array(lasts), GAMMA, LAMBDA
    )
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@given(st.lists(st.integers(1, 300), min_size=1, max_size=6), st.sampled_from([0.0, LAMBDA, 1.0]), st.integers(0, 9))
@settings(deadline=None)
def test_advantages_of_chunks_of_any_lengths_equal_the_recursion(lengths: list[int], lambda_: float, seed: int) -> None:
    rewards, values, next_values = np.random.default_rng(seed).normal(size=(3, sum(lengths)))
    lasts = np.isin(np.arange(sum(lengths)), np.cumsum(lengths) - 1)
    advantages = generalized_advantages(rewards, values, next_values, lasts, GAMMA, lambda_)
    expected = by_recursion(rewards, values, next_values, lasts, GAMMA * lambda_)
    np.testing.assert_allclose(advantages, expected, rtol=1e-12, atol=1e-12)


def test_golden_numbers() -> None:
    """Two steps, then truncated with value 2; by hand: δ = (1 + .9·1 − 0, 0 + .9·2 − 1) = (1.9, .8)."""
    found = generalized_advantages(
        np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([1.0, 2.0]), np.array([False, True]), GAMMA, LAMBDA
    )
    np.testing.assert_allclose(found, [1.9 + 0.72 * 0.8, 0.8])
