"""Base class of all policies' modules: the interface for sampling, export and parity checks."""

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from league.spaces import ACTION_MASK
from training.modules.distributions import TorchDistribution
from training.modules.encoder import Encoder
from training.modules.own_network import OwnNetwork
from training.rllib_compat import ExactStateModule

MASKED_LOGIT = -1e9
"""Logit, or value, of an illegal action: its softmax is exactly 0 in float32, and entropy and gradients stay finite."""
PREVIOUS_ACTION = "previous_action"
"""Key of the recurrent state that holds the previous action: the raw action plus one, (1,) float32; 0 before the first
action, since all state is 0 at the start of an episode. The caller that draws the action stores it.
"""


class PolicyModule(ExactStateModule):
    """Maps observations, ONNX input name → (B, …), to inputs of a distribution of raw actions.

    `_forward` returns ACTION_DIST_INPUTS (B, d), whose mode is the greedy legal action. It is exported as the graph,
    and therefore is deterministic. `_forward_exploration` returns those to sample from while learning.
    """

    distribution: TorchDistribution
    encoder: Encoder | OwnNetwork
    exploration: float = 0.0
    """The amount of exploration in `_forward_exploration`, set by the runner before each sample: DQN's probability of a
    random action, or the noise deviation of a deterministic policy.
    """

    def new_encoder(self) -> Encoder | OwnNetwork:
        """Create the encoder that `model_config` describes: `hidden`, `convolutions`, `channels` and `normalize`, or
        `network` and `normalize`."""
        config = self.model_config
        if config.get("network"):
            entry_point, kwargs = config["network"]
            return OwnNetwork(entry_point, kwargs, self.observation_space, config.get("normalize", False))
        return Encoder(
            self.observation_space,
            config["hidden"],
            config.get("convolutions", ()),
            config.get("normalize", False),
            config.get("channels"),
        )

    def greedy_outputs(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Return what the exported graph computes from `batch`."""
        return self._forward(batch)

    def get_initial_state(self) -> dict[str, NDArray]:
        """Return the state before an episode's first step, key → (width,); empty if not recurrent."""
        return {}


def mask_illegal(values: Tensor, observations: dict[str, Tensor]) -> Tensor:
    """Set the logits or values (B, n) of illegal actions to MASKED_LOGIT."""
    if ACTION_MASK not in observations:
        return values
    return torch.where(observations[ACTION_MASK].flatten(1).bool(), values, MASKED_LOGIT)
