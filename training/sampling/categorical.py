"""Categorical distributions over a batch of logits, in NumPy."""

import numpy as np
from numpy.typing import NDArray

SMALLEST = np.finfo(np.float32).tiny


def log_softmax(logits: NDArray) -> NDArray:
    """(k, n) float32 logits → (k, n) float32 log-probabilities."""
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def sample(logits: NDArray, rng: np.random.Generator) -> NDArray:
    """One index per row of (k, n) float32 logits, (k,) int64, by the Gumbel-max trick: argmax(logits + Gumbel noise) is
    distributed as softmax(logits) (Maddison, Tarlow and Minka, 2014, "A* sampling")."""
    noise = rng.standard_exponential(logits.shape, dtype=np.float32)
    # One number in some millions is exactly 0, whose infinite Gumbel noise would choose even what is masked.
    return (logits - np.log(np.maximum(noise, SMALLEST))).argmax(axis=-1)


def entropy(log_probabilities: NDArray) -> NDArray:
    """(k, n) → (k,) in nats; entries of probability 0 count 0."""
    return -(np.exp(log_probabilities) * log_probabilities).sum(axis=-1)
