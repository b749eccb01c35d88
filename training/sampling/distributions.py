"""What actions are drawn from while sampling, in NumPy: one distribution for each kind of action space.

The inputs of a distribution and its raw actions are those of `league.policies.actions`.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from league.policies.actions import dist_inputs_size
from league.spaces import Discrete, MultiDiscrete, Space
from training.modules.acting import MASKED
from training.sampling import categorical

Drawn = tuple[NDArray, NDArray]
"""Raw actions, (k,) or (k, m), and their log-probabilities, (k,) float32."""


class Distribution(Protocol):
    """Rows of inputs (k, d) float32 → a distribution of raw actions each."""

    def sample(self, inputs: NDArray, rng: np.random.Generator) -> Drawn:
        """An action of each row's distribution."""
        ...

    def mode(self, inputs: NDArray) -> Drawn:
        """The most probable action of each row."""
        ...

    def log_p(self, inputs: NDArray, raw: NDArray) -> NDArray:
        """Log-probability (density) of an action of each row, (k,) float32."""
        ...

    def entropy(self, inputs: NDArray) -> NDArray:
        """(k,) in nats."""
        ...

    def uniform(self, mask: NDArray | None, rows: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Random legal actions, and inputs that stand for them. mask: (rows, d) where the space has one."""
        ...


def distribution(space: Space) -> Distribution:
    """The distribution over the raw actions of `space`. Raises ConfigError if no policy can have it."""
    size = dist_inputs_size(space)
    match space:
        case Discrete():
            return Categorical(size)
        case MultiDiscrete(nvec=nvec):
            return MultiCategorical(np.ravel(nvec).tolist())
    return Gaussian(size // 2)


class Categorical:
    """One of n actions, by logits."""

    def __init__(self, n: int) -> None:
        self._n = n

    def sample(self, inputs: NDArray, rng: np.random.Generator) -> Drawn:
        raw = categorical.sample(inputs, rng)
        return raw, self.log_p(inputs, raw)

    def mode(self, inputs: NDArray) -> Drawn:
        raw = inputs.argmax(axis=-1)
        return raw, self.log_p(inputs, raw)

    def log_p(self, inputs: NDArray, raw: NDArray) -> NDArray:
        return categorical.log_softmax(inputs)[np.arange(len(raw)), raw]

    def entropy(self, inputs: NDArray) -> NDArray:
        return categorical.entropy(categorical.log_softmax(inputs))

    def uniform(self, mask: NDArray | None, rows: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        inputs = _unknown(mask, rows, self._n)
        return self.sample(inputs, rng)[0], inputs


class MultiCategorical:
    """Several choices, independent of one another: the logits of each stand one behind another."""

    def __init__(self, nvec: list[int]) -> None:
        self._parts = [Categorical(n) for n in nvec]
        self._cuts = np.cumsum(nvec)[:-1]
        self._size = sum(nvec)

    def sample(self, inputs: NDArray, rng: np.random.Generator) -> Drawn:
        return self._together([part.sample(of, rng) for part, of in self._split(inputs)])

    def mode(self, inputs: NDArray) -> Drawn:
        return self._together([part.mode(of) for part, of in self._split(inputs)])

    def log_p(self, inputs: NDArray, raw: NDArray) -> NDArray:
        parts = zip(self._split(inputs), raw.T, strict=True)
        return np.sum([part.log_p(of, chosen) for (part, of), chosen in parts], axis=0)

    def entropy(self, inputs: NDArray) -> NDArray:
        return np.sum([part.entropy(of) for part, of in self._split(inputs)], axis=0)

    def uniform(self, mask: NDArray | None, rows: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        inputs = _unknown(mask, rows, self._size)
        return self.sample(inputs, rng)[0], inputs

    def _split(self, inputs: NDArray) -> list[tuple[Categorical, NDArray]]:
        return list(zip(self._parts, np.split(inputs, self._cuts, axis=-1), strict=True))

    def _together(self, drawn: list[Drawn]) -> Drawn:
        actions, log_p = zip(*drawn, strict=True)
        return np.stack(actions, axis=-1), np.asarray(sum(log_p), dtype=np.float32)


class Gaussian:
    """m numbers, independent of one another: means, then logarithms of the standard deviations."""

    LOG_ROOT = 0.5 * float(np.log(2 * np.pi))

    def __init__(self, m: int) -> None:
        self._m = m

    def sample(self, inputs: NDArray, rng: np.random.Generator) -> Drawn:
        means, log_deviations = self._split(inputs)
        noise = rng.standard_normal(means.shape, dtype=np.float32)
        return means + np.exp(log_deviations) * noise, self._log_p(noise, log_deviations)

    def mode(self, inputs: NDArray) -> Drawn:
        means, log_deviations = self._split(inputs)
        return means.copy(), self._log_p(np.zeros_like(means), log_deviations)

    def log_p(self, inputs: NDArray, raw: NDArray) -> NDArray:
        means, log_deviations = self._split(inputs)
        return self._log_p((raw - means) * np.exp(-log_deviations), log_deviations)

    def entropy(self, inputs: NDArray) -> NDArray:
        """0.5 + 0.5 log 2π + log σ, summed over the elements."""
        return (0.5 + self.LOG_ROOT + self._split(inputs)[1]).sum(axis=-1)

    def uniform(self, mask: NDArray | None, rows: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:  # noqa: ARG002
        """Uniform over what bounded elements span, [-1, 1]."""
        raw = rng.uniform(-1, 1, (rows, self._m)).astype(np.float32)
        return raw, np.zeros((rows, 2 * self._m), np.float32)

    def _split(self, inputs: NDArray) -> tuple[NDArray, NDArray]:
        return inputs[:, : self._m], inputs[:, self._m :]

    def _log_p(self, noise: NDArray, log_deviations: NDArray) -> NDArray:
        return -(0.5 * noise**2 + log_deviations + np.float32(self.LOG_ROOT)).sum(axis=-1, dtype=np.float32)


def _unknown(mask: NDArray | None, rows: int, n: int) -> NDArray:
    """Logits of a choice that knows no more than the mask."""
    if mask is None:
        return np.zeros((rows, n), np.float32)
    return np.where(mask.reshape(rows, n) != 0, 0.0, MASKED).astype(np.float32)
