"""Action distributions in NumPy: sampling, log-probabilities and exploration noise, without torch.

Distribution inputs and raw actions are those of `league.policies.actions`; training/modules/distributions.py is the
torch counterpart.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from league.policies.actions import dist_inputs_size
from league.spaces import Discrete, MultiDiscrete, Space
from training.modules.policy_module import MASKED_LOGIT

MIN_EXPONENTIAL = np.finfo(np.float32).tiny


def log_softmax(logits: NDArray) -> NDArray:
    """Return log-probabilities (k, n) float32 from logits (k, n) float32."""
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True))


def sample(logits: NDArray, rng: np.random.Generator) -> NDArray:
    """Draw one index per row of logits (k, n) float32; return (k,) int64.

    Gumbel-max trick: argmax(logits + Gumbel noise) is distributed as softmax(logits) (Maddison, Tarlow and Minka, 2014,
    "A* sampling").
    """
    noise = rng.standard_exponential(logits.shape, dtype=np.float32)
    # About one number in a million is exactly 0; its infinite Gumbel noise would select even a masked action.
    return (logits - np.log(np.maximum(noise, MIN_EXPONENTIAL))).argmax(axis=-1)


def entropy(log_probabilities: NDArray) -> NDArray:
    """Return the entropies (k,) of log-probabilities (k, n), in nats; entries of probability 0 count 0."""
    return -(np.exp(log_probabilities) * log_probabilities).sum(axis=-1)


ActionsAndLogP = tuple[NDArray, NDArray]
"""Raw actions, (k,) or (k, m), and their log-probabilities, (k,) float32."""


class Distribution(Protocol):
    """Maps inputs (k, d) float32 to one distribution of raw actions per row."""

    def sample(self, inputs: NDArray, rng: np.random.Generator) -> ActionsAndLogP:
        """Draw an action per row."""

    def mode(self, inputs: NDArray) -> ActionsAndLogP:
        """Return the most probable action per row."""

    def log_p(self, inputs: NDArray, raw: NDArray) -> NDArray:
        """Return the log-probability (density) of an action per row, (k,) float32."""

    def entropy(self, inputs: NDArray) -> NDArray:
        """Return the entropies, (k,), in nats."""

    def uniform(self, mask: NDArray | None, rows: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Return random legal actions, and inputs that represent them. mask: (rows, d), if the space has one."""


def distribution(space: Space) -> Distribution:
    """Return the distribution over raw actions of `space`. Raises ConfigError for unsupported spaces."""
    size = dist_inputs_size(space)
    match space:
        case Discrete():
            return Categorical(size)
        case MultiDiscrete(nvec=nvec):
            return MultiCategorical(np.ravel(nvec).tolist())
    return Gaussian(size // 2)


class Categorical:
    """One of n actions; inputs are logits."""

    def __init__(self, n: int) -> None:
        self._n = n

    def sample(self, inputs: NDArray, rng: np.random.Generator) -> ActionsAndLogP:
        raw = sample(inputs, rng)
        return raw, self.log_p(inputs, raw)

    def mode(self, inputs: NDArray) -> ActionsAndLogP:
        raw = inputs.argmax(axis=-1)
        return raw, self.log_p(inputs, raw)

    def log_p(self, inputs: NDArray, raw: NDArray) -> NDArray:
        return log_softmax(inputs)[np.arange(len(raw)), raw]

    def entropy(self, inputs: NDArray) -> NDArray:
        return entropy(log_softmax(inputs))

    def uniform(self, mask: NDArray | None, rows: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        inputs = _uniform_logits(mask, rows, self._n)
        return self.sample(inputs, rng)[0], inputs


class MultiCategorical:
    """Independent categorical choices; inputs are their concatenated logits."""

    def __init__(self, nvec: list[int]) -> None:
        self._parts = [Categorical(n) for n in nvec]
        self._cuts = np.cumsum(nvec)[:-1]
        self._size = sum(nvec)

    def sample(self, inputs: NDArray, rng: np.random.Generator) -> ActionsAndLogP:
        return self._joint_rows([part.sample(of, rng) for part, of in self._split(inputs)])

    def mode(self, inputs: NDArray) -> ActionsAndLogP:
        return self._joint_rows([part.mode(of) for part, of in self._split(inputs)])

    def log_p(self, inputs: NDArray, raw: NDArray) -> NDArray:
        parts = zip(self._split(inputs), raw.T, strict=True)
        return np.sum([part.log_p(of, column) for (part, of), column in parts], axis=0)

    def entropy(self, inputs: NDArray) -> NDArray:
        return np.sum([part.entropy(of) for part, of in self._split(inputs)], axis=0)

    def uniform(self, mask: NDArray | None, rows: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        inputs = _uniform_logits(mask, rows, self._size)
        return self.sample(inputs, rng)[0], inputs

    def _split(self, inputs: NDArray) -> list[tuple[Categorical, NDArray]]:
        return list(zip(self._parts, np.split(inputs, self._cuts, axis=-1), strict=True))

    def _joint_rows(self, drawn: list[ActionsAndLogP]) -> ActionsAndLogP:
        actions, log_p = zip(*drawn, strict=True)
        return np.stack(actions, axis=-1), np.asarray(sum(log_p), dtype=np.float32)


class Gaussian:
    """m independent normal variables; inputs are means, then logarithms of standard deviations."""

    LOG_ROOT = 0.5 * float(np.log(2 * np.pi))

    def __init__(self, m: int) -> None:
        self._m = m

    def sample(self, inputs: NDArray, rng: np.random.Generator) -> ActionsAndLogP:
        means, log_deviations = self._split(inputs)
        noise = rng.standard_normal(means.shape, dtype=np.float32)
        return means + np.exp(log_deviations) * noise, self._log_p(noise, log_deviations)

    def mode(self, inputs: NDArray) -> ActionsAndLogP:
        means, log_deviations = self._split(inputs)
        return means.copy(), self._log_p(np.zeros_like(means), log_deviations)

    def log_p(self, inputs: NDArray, raw: NDArray) -> NDArray:
        means, log_deviations = self._split(inputs)
        return self._log_p((raw - means) * np.exp(-log_deviations), log_deviations)

    def entropy(self, inputs: NDArray) -> NDArray:
        """Return 0.5 + 0.5 log 2π + log σ, summed over the elements."""
        return (0.5 + self.LOG_ROOT + self._split(inputs)[1]).sum(axis=-1)

    def uniform(self, mask: NDArray | None, rows: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:  # noqa: ARG002
        """Draw uniformly from [-1, 1], which spans bounded elements."""
        raw = rng.uniform(-1, 1, (rows, self._m)).astype(np.float32)
        return raw, np.zeros((rows, 2 * self._m), np.float32)

    def _split(self, inputs: NDArray) -> tuple[NDArray, NDArray]:
        return inputs[:, : self._m], inputs[:, self._m :]

    def _log_p(self, noise: NDArray, log_deviations: NDArray) -> NDArray:
        return -(0.5 * noise**2 + log_deviations + np.float32(self.LOG_ROOT)).sum(axis=-1, dtype=np.float32)


def _uniform_logits(mask: NDArray | None, rows: int, n: int) -> NDArray:
    """Return logits of a uniform distribution over legal actions."""
    if mask is None:
        return np.zeros((rows, n), np.float32)
    return np.where(mask.reshape(rows, n) != 0, 0.0, MASKED_LOGIT).astype(np.float32)


class OrnsteinUhlenbeck:
    """Temporally correlated noise, one process per agent and environment, starting at 0 in each episode:

        x ← (1 − θ) x + σ ε,    ε ~ N(0, 1) for each element

    It is added to the mean of an action. Uhlenbeck and Ornstein, 1930, "On the theory of the Brownian motion", as
    used by Lillicrap et al., 2016, arXiv 1509.02971, section 7, with θ = 0.15 and σ = 0.2.
    """

    def __init__(self, theta: float, num_envs: int, agents: int, elements: int) -> None:
        self._theta = theta
        self._state = np.zeros((num_envs, agents, elements), np.float32)

    def draw(self, envs: NDArray, agents: NDArray, dist_inputs: NDArray, rng: np.random.Generator) -> NDArray:
        """Return raw actions (k, m) of the given agents. dist_inputs: (k, 2 m), means, then logarithms of σ."""
        means, log_deviations = np.split(dist_inputs, 2, axis=1)
        step = np.exp(log_deviations) * rng.standard_normal(means.shape, dtype=np.float32)
        moved = (1 - self._theta) * self._state[envs, agents] + step
        self._state[envs, agents] = moved
        return (means + moved).astype(np.float32)

    def forget(self, envs: NDArray) -> None:
        """The episodes in `envs` are over."""
        self._state[envs] = 0.0
