"""What every policy's module keeps to, whichever algorithm trains it: by this it is played, exported and proved."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.rl_module.torch import TorchRLModule

from training.modules.distributions import Distribution
from training.modules.encoder import Encoder

MASKED = -1e9
"""Logit, or value, of an illegal action: as a logit its probability is exactly 0 in float32, and entropy and gradients
stay finite."""
ACTED = "acted"
"""Key of the state of a module that remembers its last action: the raw action plus one, (1,) float32; 0 before the
first one, as all state is 0 where an episode begins. Who draws from the module's distribution puts the action there."""


class Acting(TorchRLModule):
    """Observations, dictionaries ONNX input name → (B, …), to inputs of a distribution of raw actions.

    `_forward` answers ACTION_DIST_INPUTS (B, d), whose mode is the greedy action and legal; it becomes the graph, and
    so draws nothing at random. `_forward_exploration` answers those that are played from while learning.
    """

    distribution: Distribution
    encoder: Encoder
    exploration: float = 0.0
    """How much `_forward_exploration` explores, set by the runner before each sample; what the number means is the
    algorithm's: DQN's probability of a random action, or the deviation of the noise of a deterministic policy."""

    def train(self, mode: bool = True) -> "Acting":
        """As nn.Module's, which RLlib calls at every forward pass, but without the walk where nothing changes."""
        return self if self.training == mode else super().train(mode)

    def get_state(self, *_: Any, **__: Any) -> dict[str, NDArray]:
        """Weights by name. RLlib's makes floats of doubles, but the statistics of observations must stay exact."""
        return {name: np.array(tensor.detach().cpu()) for name, tensor in self.state_dict().items()}

    def set_state(self, state: dict[str, NDArray]) -> None:
        """Take over what `get_state` gave."""
        self.load_state_dict({name: torch.tensor(array) for name, array in state.items()})

    def get_initial_state(self) -> dict[str, NDArray]:
        """The state before an episode's first step, key → (width,); empty without a memory."""
        return {}
