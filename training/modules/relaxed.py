"""Actions as a critic takes them, rows of float32, and how a policy's answer becomes one that gradients pass through.

| action space  | a row of the critic's                                | drawn from the inputs of the distribution |
|---------------|------------------------------------------------------|-------------------------------------------|
| Discrete      | one-hot                                              | straight-through Gumbel-softmax           |
| MultiDiscrete | the one-hots of its elements, one behind another     | one of each element                       |
| Box of floats | the raw numbers, clipped as the environment has them | the means: the policy is deterministic    |

Raw actions and inputs are those of league/policies/actions.py.
"""

from collections.abc import Sequence
from typing import Protocol

import gymnasium
import numpy as np
import torch
from torch import Tensor

SMALLEST = torch.finfo(torch.float32).tiny


class Relaxed(Protocol):
    """The actions of one space."""

    @property
    def width(self) -> int:
        """Numbers of a critic's row."""
        ...

    def encode(self, raw: Tensor) -> Tensor:
        """Raw actions (B,) or (B, m) → (B, width)."""
        ...

    def sample(self, dist_inputs: Tensor, temperature: float) -> Tensor:
        """(B, d) → (B, width), differentiable in `dist_inputs`."""
        ...


def relaxed(space: gymnasium.Space) -> Relaxed:
    """The actions of a space that a policy can have: see training.modules.distributions.distribution."""
    match space:
        case gymnasium.spaces.Discrete():
            return Choices([int(space.n)])
        case gymnasium.spaces.MultiDiscrete():
            return Choices(space.nvec.ravel().tolist())
    assert isinstance(space, gymnasium.spaces.Box), "module_spec refuses it"
    return Numbers(space)


class Choices:
    """One of each of some sizes."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self._sizes = list(sizes)

    @property
    def width(self) -> int:
        return sum(self._sizes)

    def encode(self, raw: Tensor) -> Tensor:
        chosen = raw.reshape(len(raw), len(self._sizes))
        return torch.cat([one_hot(chosen[:, i], n) for i, n in enumerate(self._sizes)], dim=-1)

    def sample(self, dist_inputs: Tensor, temperature: float) -> Tensor:
        parts = dist_inputs.split(self._sizes, dim=-1)
        return torch.cat([gumbel_softmax(part, temperature, gumbel(part)) for part in parts], dim=-1)


class Numbers:
    """The elements of a Box of floats."""

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        low, high = (np.ravel(bound).astype(np.float32) for bound in (space.low, space.high))
        is_bounded = np.isfinite(low) & np.isfinite(high)
        self._low = torch.as_tensor(np.where(is_bounded, -1, low))
        self._high = torch.as_tensor(np.where(is_bounded, 1, high))

    @property
    def width(self) -> int:
        return len(self._low)

    def encode(self, raw: Tensor) -> Tensor:
        """What noise carries beyond the bounds has not happened in the environment."""
        return raw.clamp(self._low.to(raw.device), self._high.to(raw.device))

    def sample(self, dist_inputs: Tensor, temperature: float) -> Tensor:  # noqa: ARG002
        return dist_inputs[:, : self.width]


def gumbel(like: Tensor) -> Tensor:
    """Standard Gumbel noise, −log(−log(u)) of uniform u, in the shape of `like`."""
    # A u of exactly 0 would be infinite noise, and choose even what is masked.
    return -torch.rand_like(like).clamp_min(SMALLEST).log().neg().log()


def gumbel_softmax(logits: Tensor, temperature: float, noise: Tensor) -> Tensor:
    """A one-hot row whose gradient is that of its relaxation, (B, n) each:

        y = softmax((logits + noise) / τ),    one-hot(argmax y) + y − stop-gradient(y)

    With Gumbel noise the argmax is distributed as softmax(logits), whatever τ is. Jang, Gu and Poole, 2017,
    "Categorical reparameterization with Gumbel-softmax", arXiv 1611.01144, equation 2 and section 2.2.
    """
    assert logits.shape == noise.shape
    if not torch.is_grad_enabled():
        return one_hot((logits + noise).argmax(dim=-1), logits.shape[-1])
    soft = torch.softmax((logits + noise) / temperature, dim=-1)
    hard = one_hot(soft.argmax(dim=-1), soft.shape[-1])
    # In this order, as hard + soft − soft would not be exactly one-hot.
    return hard + (soft - soft.detach())


def one_hot(index: Tensor, n: int) -> Tensor:
    """(B,) integers → (B, n) float32."""
    return (index.unsqueeze(-1) == torch.arange(n, device=index.device)).float()
