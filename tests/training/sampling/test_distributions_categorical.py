import numpy as np
import pytest
from scipy.stats import chisquare

from training.sampling import distributions


def test_log_softmax_of_masked_logits() -> None:
    found = distributions.log_softmax(np.array([[0.0, np.log(3), -1e9]], np.float32))
    np.testing.assert_allclose(np.exp(found), [[0.25, 0.75, 0.0]], atol=1e-6)
    assert found.dtype == np.float32


def test_samples_follow_the_distribution() -> None:
    p = np.array([0.5, 0.3, 0.2, 0.0])
    with np.errstate(divide="ignore"):
        log_p = np.maximum(np.log(p), -1e9).astype(np.float32)
    samples = distributions.sample(np.tile(log_p, (20_000, 1)), np.random.default_rng(1))
    counts = np.bincount(samples, minlength=4)
    assert counts[3] == 0
    assert chisquare(counts[:3], 20_000 * p[:3]).pvalue > 1e-3


def test_masked_actions_are_not_sampled_if_the_noise_is_zero() -> None:
    class Zeros:
        def standard_exponential(self, shape: tuple[int, ...], dtype: type) -> np.ndarray:
            return np.where(np.arange(shape[-1]) == 0, 0, np.ones(shape)).astype(dtype)

    log_p = np.array([[-1e9, -0.7, -0.7]], np.float32)
    assert distributions.sample(log_p, Zeros()) == [1]  # type: ignore[arg-type]


def test_entropy_in_nats() -> None:
    uniform = distributions.log_softmax(np.zeros((1, 4), np.float32))
    certain = distributions.log_softmax(np.array([[0.0, -1e9]], np.float32))
    np.testing.assert_allclose(distributions.entropy(uniform), [np.log(4)], rtol=1e-6)
    assert distributions.entropy(certain).tolist() == pytest.approx([0.0])
