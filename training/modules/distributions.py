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
    """One of n; inputs are logits."""

    n: int

    @property
    def outputs(self) -> int:
        return self.n

    def evaluate(self, inputs: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        log_p = torch.log_softmax(inputs, dim=-1)
        return log_p.gather(-1, raw.unsqueeze(-1)).squeeze(-1), -(log_p.exp() * log_p).sum(-1)

    def divergence(self, old: Tensor, new: Tensor) -> Tensor:
        old, new = torch.log_softmax(old, dim=-1), torch.log_softmax(new, dim=-1)
        return (old.exp() * (old - new)).sum(-1)

    def mode(self, inputs: Tensor) -> Tensor:
        return inputs.argmax(dim=-1)


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

    def mode(self, inputs: Tensor) -> Tensor:
        return inputs.chunk(2, dim=-1)[0]
