"""Categorical distributions over a batch of logits, in NumPy."""

import numpy as np
from numpy.typing import NDArray

SMALLEST = np.finfo(np.float32).tiny


def log_softmax(logits: NDArray) -> NDArray:
    """(k, n) float32 logits → (k, n) float32 log-probabilities."""
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def sample(log_probabilities: NDArray, rng: np.random.Generator) -> NDArray:
    """One index per row, (k,) int64, by the Gumbel-max trick: argmax(log p + Gumbel noise) is distributed as p
    (Maddison, Tarlow and Minka, 2014, "A* sampling")."""
    noise = rng.standard_exponential(log_probabilities.shape, dtype=np.float32)
    # One number in some millions is exactly 0, whose infinite Gumbel noise would choose even what is masked.
    return (log_probabilities - np.log(np.maximum(noise, SMALLEST))).argmax(axis=-1)


def entropy(log_probabilities: NDArray) -> NDArray:
    """(k, n) → (k,) in nats; entries of probability 0 count 0."""
    return -(np.exp(log_probabilities) * log_probabilities).sum(axis=-1)
