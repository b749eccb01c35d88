"""A masked actor-critic multilayer perceptron."""

from typing import Any

import gymnasium
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.torch import TorchRLModule
from torch import Tensor, nn

from league.errors import ConfigError
from league.spaces import ACTION_MASK
from training.modules.features import Features

MASKED = -1e9
"""Logit of an illegal action: its probability is exactly 0 in float32, and entropy and gradients stay finite."""


class ActorCritic(TorchRLModule, ValueFunctionAPI):
    """One trunk, a policy head and a value head, for Discrete actions.

    Observations are dictionaries ONNX input name → tensor (B, …) in the environment's dtype; `action_mask` (B, n) of
    0 and 1 is optional. `observation_space` is the Dict of those names. model_config: `hidden`, the trunk's widths;
    `convolutions`, (filters, kernel) each, before it.
    """

    def setup(self) -> None:
        if not isinstance(self.action_space, gymnasium.spaces.Discrete):
            raise ConfigError(f"training: PPO takes Discrete actions, the environment has {self.action_space}")
        self.features = Features(self.observation_space, self.model_config.get("convolutions", ()))
        layers: list[nn.Module] = []
        width = self.features.width
        for hidden in self.model_config["hidden"]:
            layers += [_linear(width, hidden, gain=2**0.5), nn.ReLU()]
            width = hidden
        self.trunk = nn.Sequential(*layers)
        # A first policy close to uniform, as in Andrychowicz et al. (2021), "What matters for on-policy deep
        # actor-critic methods?", section 3.2.
        self.policy_head = _linear(width, int(self.action_space.n), gain=0.01)
        self.value_head = _linear(width, 1, gain=1.0)

    def train(self, mode: bool = True) -> "ActorCritic":
        """As nn.Module's, which RLlib calls at every forward pass, but without the walk where nothing changes."""
        return self if self.training == mode else super().train(mode)

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Tensor]:
        return self._act(batch[Columns.OBS], self.trunk(self.features(batch[Columns.OBS])))

    def _forward_train(self, batch: dict[str, Any], **_: Any) -> dict[str, Tensor]:
        embeddings = self.trunk(self.features(batch[Columns.OBS]))
        return {Columns.EMBEDDINGS: embeddings} | self._act(batch[Columns.OBS], embeddings)

    def compute_values(self, batch: dict[str, Any], embeddings: Tensor | None = None) -> Tensor:
        """(B,) values of the observations in `batch`."""
        if embeddings is None:
            embeddings = self.trunk(self.features(batch[Columns.OBS]))
        return self.value_head(embeddings).squeeze(-1)

    def _act(self, observations: dict[str, Tensor], embeddings: Tensor) -> dict[str, Tensor]:
        logits = self.policy_head(embeddings)
        if ACTION_MASK in observations:
            logits = torch.where(observations[ACTION_MASK] != 0, logits, MASKED)
        return {Columns.ACTION_DIST_INPUTS: logits}


def _linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
