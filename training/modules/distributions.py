"""Action distributions in torch, for losses and exported graphs; see league/policies/actions.py for the convention.

training/sampling/distributions.py is the NumPy counterpart.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import gymnasium
import numpy as np
import torch
from torch import Tensor

from league.errors import ConfigError


class TorchDistribution(Protocol):
    """A distribution of raw actions. inputs: (k, d) float32. raw: (k,) or (k, m). Results: (k,)."""

    @property
    def outputs(self) -> int:
        """The number of network outputs among the d inputs."""

    def evaluate(self, inputs: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-probabilities (densities) of the raw actions, and the entropies in nats."""

    def divergence(self, old: Tensor, new: Tensor) -> Tensor:
        """Return KL(old || new) per row."""

    def gradient(self, inputs: Tensor, raw: Tensor, by_log_p: Tensor, by_entropy: float) -> Tensor:
        """Return the gradient by `inputs`, (k, d), of a function of what `evaluate` returns, row by row.

        by_log_p, (k,), and by_entropy are its derivatives by the log-probability and the entropy.
        """

    def divergence_gradient(self, old: Tensor, new: Tensor) -> Tensor:
        """Return the gradient of KL(old || new) by `old`, (k, d), row by row."""

    def mode(self, inputs: Tensor) -> Tensor:
        """Return the most probable raw actions."""


def torch_distribution(space: gymnasium.Space) -> TorchDistribution:
    """Return the distribution over raw actions of `space`. Raises ConfigError for unsupported spaces."""
    match space:
        case gymnasium.spaces.Discrete():
            return TorchCategorical(int(space.n))
        case gymnasium.spaces.MultiDiscrete():
            return TorchMultiCategorical(tuple(space.nvec.ravel().tolist()))
        case gymnasium.spaces.Box() if np.issubdtype(space.dtype, np.floating):
            return TorchGaussian(math.prod(space.shape))
    raise ConfigError(
        f"training: unsupported action space {space}: expected Discrete, MultiDiscrete or a Box of floats"
    )


@dataclass(frozen=True, slots=True)
class TorchCategorical:
    """One of n; inputs are logits z. With p = softmax(z) and the divergence D from q:

    ∂ log p_a / ∂z_j = [j = a] − p_j,    ∂H / ∂z_j = −p_j (log p_j + H),    ∂D / ∂z_j = p_j (log p_j − log q_j − D)
    """

    n: int

    @property
    def outputs(self) -> int:
        return self.n

    def evaluate(self, inputs: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        log_p = _log_probabilities(inputs)
        return log_p.gather(0, raw.unsqueeze(0)).squeeze(0), -(log_p.exp() * log_p).sum(0)

    def divergence(self, old: Tensor, new: Tensor) -> Tensor:
        old, new = _log_probabilities(old), _log_probabilities(new)
        return (old.exp() * (old - new)).sum(0)

    def gradient(self, inputs: Tensor, raw: Tensor, by_log_p: Tensor, by_entropy: float) -> Tensor:
        log_p = _log_probabilities(inputs)
        p = log_p.exp()
        weighted = p * log_p
        gradient = p * (by_entropy * weighted.sum(0) - by_log_p) - by_entropy * weighted
        return gradient.scatter_add_(0, raw.unsqueeze(0), by_log_p.unsqueeze(0)).t()

    def divergence_gradient(self, old: Tensor, new: Tensor) -> Tensor:
        old, new = _log_probabilities(old), _log_probabilities(new)
        p = old.exp()
        weighted = p * (old - new)
        return (weighted - p * weighted.sum(0)).t()

    def mode(self, inputs: Tensor) -> Tensor:
        return inputs.argmax(dim=-1)


def _log_probabilities(logits: Tensor) -> Tensor:
    """(k, n) → (n, k): on the CPU, torch normalises long rows ten times as fast as short ones."""
    return torch.log_softmax(logits.t(), dim=0)


@dataclass(frozen=True, slots=True)
class TorchMultiCategorical:
    """Independent choices, one of sizes[i] each; inputs are their concatenated logits."""

    sizes: tuple[int, ...]

    @property
    def outputs(self) -> int:
        return sum(self.sizes)

    def evaluate(self, inputs: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        parts = [
            TorchCategorical(n).evaluate(part, raw[:, i])
            for i, (n, part) in enumerate(zip(self.sizes, inputs.split(self.sizes, dim=-1), strict=True))
        ]
        return torch.stack([log_p for log_p, _ in parts]).sum(0), torch.stack([entropy for _, entropy in parts]).sum(0)

    def divergence(self, old: Tensor, new: Tensor) -> Tensor:
        pairs = zip(self.sizes, old.split(self.sizes, dim=-1), new.split(self.sizes, dim=-1), strict=True)
        return torch.stack([TorchCategorical(n).divergence(before, after) for n, before, after in pairs]).sum(0)

    def gradient(self, inputs: Tensor, raw: Tensor, by_log_p: Tensor, by_entropy: float) -> Tensor:
        parts = zip(self.sizes, inputs.split(self.sizes, dim=-1), raw.unbind(dim=-1), strict=True)
        return torch.cat([TorchCategorical(n).gradient(part, one, by_log_p, by_entropy) for n, part, one in parts], -1)

    def divergence_gradient(self, old: Tensor, new: Tensor) -> Tensor:
        pairs = zip(self.sizes, old.split(self.sizes, dim=-1), new.split(self.sizes, dim=-1), strict=True)
        return torch.cat([TorchCategorical(n).divergence_gradient(before, after) for n, before, after in pairs], -1)

    def mode(self, inputs: Tensor) -> Tensor:
        return torch.stack([part.argmax(dim=-1) for part in inputs.split(self.sizes, dim=-1)], dim=-1)


@dataclass(frozen=True, slots=True)
class TorchGaussian:
    """m independent normal variables; inputs are means, then logarithms of standard deviations."""

    m: int

    @property
    def outputs(self) -> int:
        return self.m

    def evaluate(self, inputs: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_deviation = inputs.chunk(2, dim=-1)
        standard = (raw - mean) * torch.exp(-log_deviation)
        log_p = -(0.5 * standard.square() + log_deviation).sum(-1) - self.m * 0.5 * math.log(2 * math.pi)
        return log_p, log_deviation.sum(-1) + self.m * 0.5 * math.log(2 * math.pi * math.e)

    def divergence(self, old: Tensor, new: Tensor) -> Tensor:
        (mean, log_deviation), (new_mean, new_log) = old.chunk(2, dim=-1), new.chunk(2, dim=-1)
        spread = torch.exp(2 * (log_deviation - new_log)) + ((mean - new_mean) * torch.exp(-new_log)).square()
        return (new_log - log_deviation + 0.5 * (spread - 1)).sum(-1)

    def gradient(self, inputs: Tensor, raw: Tensor, by_log_p: Tensor, by_entropy: float) -> Tensor:
        mean, log_deviation = inputs.chunk(2, dim=-1)
        precision = torch.exp(-log_deviation)
        standard, weight = (raw - mean) * precision, by_log_p.unsqueeze(-1)
        return torch.cat([weight * standard * precision, weight * (standard.square() - 1) + by_entropy], dim=-1)

    def divergence_gradient(self, old: Tensor, new: Tensor) -> Tensor:
        (mean, log_deviation), (new_mean, new_log) = old.chunk(2, dim=-1), new.chunk(2, dim=-1)
        by_mean = (mean - new_mean) * torch.exp(-2 * new_log)
        return torch.cat([by_mean, torch.exp(2 * (log_deviation - new_log)) - 1], dim=-1)

    def mode(self, inputs: Tensor) -> Tensor:
        return inputs.chunk(2, dim=-1)[0]
