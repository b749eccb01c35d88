"""The networks of MADDPG: deterministic actors, centralised critics, and the critics' encoding of actions.

| action space  | row of a critic's input                             | sampled from the distribution inputs      |
|---------------|-----------------------------------------------------|-------------------------------------------|
| Discrete      | one-hot                                             | straight-through Gumbel-softmax           |
| MultiDiscrete | concatenated one-hots of its elements               | the same for each element                 |
| Box of floats | raw numbers, clipped as the environment clips them  | the means: the policy is deterministic    |

Raw actions and distribution inputs are those of league/policies/actions.py.
"""

from collections.abc import Sequence
from typing import Protocol

import gymnasium
import numpy as np
import torch
from ray.rllib.core.columns import Columns
from torch import Tensor, nn

from league.config.network import Channels
from training.modules.distributions import TorchGaussian, torch_distribution
from training.modules.encoder import Convolutions, ObservationFeatures, linear
from training.modules.policy_module import PolicyModule, mask_illegal

MIN_UNIFORM = torch.finfo(torch.float32).tiny


class CriticActions(Protocol):
    """Encodes the actions of one space for critics."""

    @property
    def width(self) -> int:
        """The size of a row."""

    def encode(self, raw: Tensor) -> Tensor:
        """Encode raw actions (B,) or (B, m) as (B, width)."""

    def sample(self, dist_inputs: Tensor, temperature: float) -> Tensor:
        """Sample from distribution inputs (B, d); return (B, width), differentiable in `dist_inputs`."""


def critic_actions(space: gymnasium.Space) -> CriticActions:
    """Return the encoding of a supported space: see training.modules.distributions.torch_distribution."""
    match space:
        case gymnasium.spaces.Discrete():
            return OneHotActions([int(space.n)])
        case gymnasium.spaces.MultiDiscrete():
            return OneHotActions(space.nvec.ravel().tolist())
    assert isinstance(space, gymnasium.spaces.Box), "module_spec refuses it"
    return BoxActions(space)


class OneHotActions:
    """One choice of each of some sizes."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self._sizes = list(sizes)

    @property
    def width(self) -> int:
        return sum(self._sizes)

    def encode(self, raw: Tensor) -> Tensor:
        indices = raw.reshape(len(raw), len(self._sizes))
        return torch.cat([one_hot(indices[:, i], n) for i, n in enumerate(self._sizes)], dim=-1)

    def sample(self, dist_inputs: Tensor, temperature: float) -> Tensor:
        parts = dist_inputs.split(self._sizes, dim=-1)
        return torch.cat([gumbel_softmax(part, temperature, gumbel(part)) for part in parts], dim=-1)


class BoxActions(nn.Module):
    """The elements of a Box of floats."""

    low: Tensor
    high: Tensor

    def __init__(self, space: gymnasium.spaces.Box) -> None:
        super().__init__()
        low, high = (np.ravel(bound).astype(np.float32) for bound in (space.low, space.high))
        is_bounded = np.isfinite(low) & np.isfinite(high)
        self.register_buffer("low", torch.as_tensor(np.where(is_bounded, -1, low)), persistent=False)
        self.register_buffer("high", torch.as_tensor(np.where(is_bounded, 1, high)), persistent=False)

    @property
    def width(self) -> int:
        return len(self.low)

    def encode(self, raw: Tensor) -> Tensor:
        """Clip to the bounds, since the environment does so, too."""
        return raw.clamp(self.low, self.high)

    def sample(self, dist_inputs: Tensor, temperature: float) -> Tensor:  # noqa: ARG002
        return dist_inputs[:, : self.width]


def gumbel(like: Tensor) -> Tensor:
    """Return standard Gumbel noise, −log(−log(u)) of uniform u, in the shape of `like`."""
    # A u of exactly 0 gives infinite noise, which would select even a masked action.
    return -torch.rand_like(like).clamp_min(MIN_UNIFORM).log().neg().log()


def gumbel_softmax(logits: Tensor, temperature: float, noise: Tensor) -> Tensor:
    """Return one-hot rows with the gradient of their relaxation, (B, n) each:

        y = softmax((logits + noise) / τ),    one-hot(argmax y) + y − stop-gradient(y)

    With Gumbel noise, the argmax is distributed as softmax(logits) for all τ. Jang, Gu and Poole, 2017,
    "Categorical reparameterization with Gumbel-softmax", arXiv 1611.01144, equation 2 and section 2.2.
    """
    assert logits.shape == noise.shape
    if not torch.is_grad_enabled():
        return one_hot((logits + noise).argmax(dim=-1), logits.shape[-1])
    soft = torch.softmax((logits + noise) / temperature, dim=-1)
    hard = one_hot(soft.argmax(dim=-1), soft.shape[-1])
    # The parentheses matter: hard + soft − soft would not be exactly one-hot.
    return hard + (soft - soft.detach())


def one_hot(index: Tensor, n: int) -> Tensor:
    """(B,) integers → (B, n) float32."""
    return (index.unsqueeze(-1) == torch.arange(n, device=index.device)).float()


MIN_DEVIATION = 1e-3
"""Minimum deviation of the exploration noise, in raw units: the logarithm of 0 would not be finite."""


class Actor(PolicyModule):
    """Encoder and head on the agent's own observation.

    Box of floats: tanh of the head's outputs for elements with two bounds, whose span it covers; the outputs themselves
    for others. The buffer `deviation` is the current exploration noise in raw units. It is part of the weights and of
    the graph, so that a version explores as it did when it was created.
    Choices: masked logits. Sampling from them equals a straight-through Gumbel-softmax at any temperature.

    model_config: `hidden`, `convolutions`, `channels`, `normalize` of the encoder.
    """

    deviation: Tensor
    is_bounded: Tensor
    """(m,) bool: the elements of a Box that have two bounds; empty for other spaces."""

    def setup(self) -> None:
        self.distribution = torch_distribution(self.action_space)
        self.relaxed = critic_actions(self.action_space)
        self.encoder = self.new_encoder()
        # Initial actions are in the middle of the bounds, where tanh is steepest, or nearly uniform.
        self.head = linear(self.encoder.width, self.distribution.outputs, gain=0.01)
        self.is_continuous = isinstance(self.distribution, TorchGaussian)
        self.register_buffer("deviation", torch.tensor(1.0))
        is_bounded = torch.zeros(0, dtype=torch.bool)
        if isinstance(self.action_space, gymnasium.spaces.Box):
            finite = np.isfinite(self.action_space.low) & np.isfinite(self.action_space.high)
            is_bounded = torch.as_tensor(np.ravel(finite))
        self.register_buffer("is_bounded", is_bounded, persistent=False)

    @property
    def exploration(self) -> float:
        """The deviation of the exploration noise, in raw units."""
        return float(self.deviation)

    @exploration.setter
    def exploration(self, deviation: float) -> None:
        """The deviation of the exploration noise, in raw units."""
        self.deviation.fill_(max(deviation, MIN_DEVIATION))

    def head_outputs(self, observations: dict[str, Tensor]) -> Tensor:
        """Return the head's outputs, (B, d): unmasked logits, or numbers before tanh."""
        return self.head(self.encoder(observations))

    def dist_inputs(self, answers: Tensor, observations: dict[str, Tensor]) -> Tensor:
        """Return the distribution inputs, (B, d), or (B, 2 m) for a Box."""
        if self.is_continuous:
            means = torch.where(self.is_bounded, torch.tanh(answers), answers)
            return torch.cat([means, self.deviation.log().expand_as(means)], dim=-1)
        return mask_illegal(answers, observations)

    def act(self, observations: dict[str, Tensor], temperature: float) -> tuple[Tensor, Tensor]:
        """Return differentiable actions in the critics' encoding, (B, width), and the head's outputs."""
        answers = self.head_outputs(observations)
        return self.relaxed.sample(self.dist_inputs(answers, observations), temperature), answers

    def _forward(self, batch: dict[str, dict[str, Tensor]], **_: object) -> dict[str, Tensor]:
        observations = batch[Columns.OBS]
        return {Columns.ACTION_DIST_INPUTS: self.dist_inputs(self.head_outputs(observations), observations)}


class Critic(nn.Module):
    """Q(o_1 … o_k, a_1 … a_k): hidden layers on the features of all observations and all actions."""

    def __init__(
        self,
        observations: Sequence[gymnasium.spaces.Dict],
        actions: Sequence[gymnasium.Space],
        hidden: Sequence[int],
        convolutions: Convolutions = (),
        normalize: bool = False,
        channels: Channels | None = None,
    ) -> None:
        """Args:
        observations: The spaces of the k agents' observations, Dicts ONNX input name → part.
        actions: The spaces of their actions.
        hidden: Widths of the layers, each followed by ReLU.
        convolutions: See ObservationFeatures.
        normalize: See ObservationFeatures.
        channels: See ObservationFeatures.
        """
        super().__init__()
        observed = [ObservationFeatures(space, convolutions, normalize, channels) for space in observations]
        self.observed = nn.ModuleList(observed)
        layers: list[nn.Module] = []
        width = sum(part.width for part in observed) + sum(critic_actions(space).width for space in actions)
        for wide in hidden:
            layers += [linear(width, wide, gain=2**0.5), nn.ReLU()]
            width = wide
        self.value = nn.Sequential(*layers, linear(width, 1, gain=1.0))

    def forward(self, observations: Sequence[dict[str, Tensor]], actions: Sequence[Tensor]) -> Tensor:
        """k observations, ONNX input name → (B, …), and k encoded actions (B, width) → (B,)."""
        rows = [part(observed) for part, observed in zip(self.observed, observations, strict=True)]
        return self.value(torch.cat([*rows, *actions], dim=-1)).squeeze(-1)

    def update_statistics(self, observations: Sequence[dict[str, Tensor]]) -> None:
        """Update the running statistics of the observations, if normalised."""
        for part, observed in zip(self.observed, observations, strict=True):
            assert isinstance(part, ObservationFeatures)
            part.update_statistics(observed)
