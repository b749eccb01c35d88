"""Compared with independent implementations in SciPy and torch."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare, kstest

from league.errors import ConfigError
from league.spaces import Box, Discrete, MultiDiscrete, Space
from training.modules.policy_module import MASKED_LOGIT
from training.sampling import distributions
from training.sampling.distributions import OrnsteinUhlenbeck, distribution

ROWS = 20_000
NVEC = [2, 3, 4]
SEVERAL = MultiDiscrete(nvec=NVEC, start=[0, 0, 0], shape=(3,))
NUMBERS = Box(dtype="float32", shape=(2,), low=-1.0, high=1.0)
SPACES: list[tuple[Space, int]] = [(Discrete(n=4, start=2), 4), (SEVERAL, 9), (NUMBERS, 4)]
seeds = st.integers(0, 2**32 - 1)


def torch_distribution(space: Space, inputs: np.ndarray) -> torch.distributions.Distribution:
    """torch's distribution for the same inputs."""
    tensor = torch.from_numpy(inputs).double()
    if isinstance(space, Discrete):
        return torch.distributions.Categorical(logits=tensor)
    means, log_deviations = tensor.chunk(2, dim=-1)
    return torch.distributions.Independent(torch.distributions.Normal(means, log_deviations.exp()), 1)


def expected(space: Space, inputs: np.ndarray, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log-probabilities and entropies computed by torch."""
    if isinstance(space, MultiDiscrete):
        parts = np.split(inputs, np.cumsum(NVEC)[:-1], axis=1)
        pairs = [expected(Discrete(n=n), part, raw[:, i]) for i, (n, part) in enumerate(zip(NVEC, parts, strict=True))]
        return sum(pair[0] for pair in pairs), sum(pair[1] for pair in pairs)
    reference = torch_distribution(space, inputs)
    return reference.log_prob(torch.from_numpy(raw)).numpy(), reference.entropy().numpy()


@pytest.mark.parametrize(("space", "d"), SPACES, ids=lambda value: getattr(value, "type", None))
@given(seed=seeds, rows=st.integers(1, 7), masked=st.booleans())
@settings(max_examples=25)
def test_probabilities_and_entropies_equal_torch(space: Space, d: int, seed: int, rows: int, masked: bool) -> None:
    rng = np.random.default_rng(seed)
    sampler, inputs = distribution(space), rng.normal(size=(rows, d)).astype(np.float32)
    if masked and not isinstance(space, Box):
        inputs[:, 1] = MASKED_LOGIT
    for raw, log_p in (sampler.sample(inputs, rng), sampler.mode(inputs)):
        log_probabilities, entropies = expected(space, inputs, raw)
        assert log_p.dtype == np.float32
        assert log_p.shape == (rows,)
        np.testing.assert_allclose(log_p, log_probabilities, atol=1e-4)
        np.testing.assert_allclose(sampler.log_p(inputs, raw), log_probabilities, atol=1e-4)
        np.testing.assert_allclose(sampler.entropy(inputs), entropies, atol=1e-4)


def test_the_mode_is_the_most_probable_action() -> None:
    several = np.array([[0, 1, 3, 2, 2.5, 9, 8, 7, 8.5]], np.float32)
    assert distribution(SEVERAL).mode(several)[0].tolist() == [[1, 0, 0]]
    assert distribution(Discrete(n=4)).mode(several[:, :4])[0].tolist() == [2]
    assert distribution(NUMBERS).mode(np.array([[0.25, -3, 0, 1]], np.float32))[0].tolist() == [[0.25, -3.0]]


def test_multidiscrete_samples_follow_their_probabilities_and_masks() -> None:
    p = [np.array([0.3, 0.7]), np.array([0.2, 0.0, 0.8]), np.array([0.1, 0.2, 0.3, 0.4])]
    with np.errstate(divide="ignore"):
        logits = np.maximum(np.log(np.concatenate(p)), MASKED_LOGIT).astype(np.float32)
    raw, _ = distribution(SEVERAL).sample(np.tile(logits, (ROWS, 1)), np.random.default_rng(1))
    assert raw.dtype == np.int64
    for i, probabilities in enumerate(p):
        counts = np.bincount(raw[:, i], minlength=len(probabilities))
        assert not counts[probabilities == 0].any()
        allowed = probabilities > 0
        assert chisquare(counts[allowed], ROWS * probabilities[allowed]).pvalue > 1e-3
    joint = np.bincount(raw[:, 0] * 4 + raw[:, 2], minlength=8)
    assert chisquare(joint, ROWS * np.outer(p[0], p[2]).ravel()).pvalue > 1e-3


def test_box_samples_are_normal_and_independent() -> None:
    inputs = np.tile(np.array([1.0, -2.0, np.log(0.5), np.log(3)], np.float32), (ROWS, 1))
    raw, _ = distribution(NUMBERS).sample(inputs, np.random.default_rng(1))
    assert raw.dtype == np.float32
    assert kstest(raw[:, 0], "norm", (1.0, 0.5)).pvalue > 1e-3
    assert kstest(raw[:, 1], "norm", (-2.0, 3.0)).pvalue > 1e-3
    assert abs(np.corrcoef(raw.T)[0, 1]) < 4 / np.sqrt(ROWS)


def test_random_actions_are_uniform_over_legal_actions() -> None:
    rng = np.random.default_rng(1)
    mask = np.tile(np.array([1, 1, 0, 1, 1, 1, 0, 0, 1], np.int8), (ROWS, 1))
    raw, inputs = distribution(SEVERAL).uniform(mask, ROWS, rng)
    assert inputs.shape == (ROWS, 9)
    for i, legal in enumerate(([0, 1], [1, 2], [0, 3])):
        counts = np.bincount(raw[:, i], minlength=4)
        assert counts[legal].sum() == ROWS
        assert chisquare(counts[legal]).pvalue > 1e-3
    numbers, _ = distribution(NUMBERS).uniform(None, ROWS, rng)
    assert kstest(numbers.ravel(), "uniform", (-1, 2)).pvalue > 1e-3


def test_unsupported_spaces_are_rejected() -> None:
    with pytest.raises(ConfigError, match="expected Discrete, MultiDiscrete or a Box of floats"):
        distribution(Box(dtype="int32", shape=(2,), low=0, high=5))


def test_masked_actions_are_not_sampled_if_the_noise_is_zero() -> None:
    class Zeros:
        def standard_exponential(self, shape: tuple[int, ...], dtype: type) -> np.ndarray:
            return np.where(np.arange(shape[-1]) == 0, 0, np.ones(shape)).astype(dtype)

    log_p = np.array([[-1e9, -0.7, -0.7]], np.float32)
    assert distributions.sample(log_p, Zeros()) == [1]  # type: ignore[arg-type]


THETA, SIGMA = 0.15, 0.2


def walk(steps: int, num_envs: int = 1) -> np.ndarray:
    """(steps, environments) of one agent with one element, around a mean of 3."""
    noise, rng = OrnsteinUhlenbeck(THETA, num_envs, 1, 1), np.random.default_rng(0)
    inputs = np.tile(np.array([[3.0, np.log(SIGMA)]], np.float32), (num_envs, 1))
    rows = range(num_envs)
    return np.stack([noise.draw(list(rows), [0] * num_envs, inputs, rng)[:, 0] for _ in range(steps)])


def test_the_noise_follows_its_equation() -> None:
    rng = np.random.default_rng(0)
    state, expected = 0.0, []
    for _ in range(20):
        state = (1 - THETA) * state + SIGMA * rng.standard_normal(dtype=np.float32)
        expected.append(3 + state)
    assert walk(20)[:, 0] == pytest.approx(np.array(expected), abs=1e-6)


def test_the_noise_is_correlated_and_stationary() -> None:
    late = walk(200, num_envs=4000)[100:] - 3
    deviation = SIGMA / np.sqrt(1 - (1 - THETA) ** 2)
    assert late.std() == pytest.approx(deviation, rel=0.02)
    assert (late[1:] * late[:-1]).mean() / late.var() == pytest.approx(1 - THETA, abs=0.02)


def test_each_agent_has_its_own_noise_until_its_episode_ends() -> None:
    noise, rng = OrnsteinUhlenbeck(THETA, 2, 2, 1), np.random.default_rng(0)
    noisy, quiet = np.array([[0.0, 2.0]], np.float32), np.array([[0.0, -50.0]], np.float32)
    for env in (0, 1):
        noise.draw([env], [1], noisy, rng)
    assert noise.draw([0], [0], quiet, rng)[0, 0] == pytest.approx(0, abs=1e-6), "the other agent has its own noise"
    noise.forget(0)
    assert noise.draw([0], [1], quiet, rng)[0, 0] == pytest.approx(0, abs=1e-6)
    assert abs(noise.draw([1], [1], quiet, rng)[0, 0]) > 0.01, "the noise of the other environment continues"
