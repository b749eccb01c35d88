"""The actor of a deterministic policy: Lillicrap et al., 2016, "Continuous control with deep reinforcement learning",
arXiv 1509.02971; for choices, logits whose Gumbel-softmax is the action (Jang, Gu and Poole, 2017, arXiv 1611.01144).
"""

import gymnasium
import numpy as np
import torch
from ray.rllib.core.columns import Columns
from torch import Tensor

from league.spaces import ACTION_MASK
from training.modules.acting import MASKED, Acting
from training.modules.distributions import Gaussian, distribution
from training.modules.encoder import Encoder, linear
from training.modules.relaxed import relaxed

SMALLEST_DEVIATION = 1e-3
"""Of the exploration noise, in raw units: without any, its logarithm would not be finite."""


class Actor(Acting):
    """Encoder and a head that sees nothing but the agent's own observation.

    Box of floats: elements with two bounds are tanh of the head's answers, which spans the bounds, the others are the
    answers themselves. `deviation`, a buffer, is the exploration noise of the moment, in raw units: it is part of the
    weights and of the graph, so that who explores with a version explores as it did when it was made.
    Choices: masked logits. Drawing from them is what a straight-through Gumbel-softmax does, whatever its temperature.

    model_config: `hidden`, `convolutions`, `normalize` of the encoder.
    """

    deviation: Tensor
    is_bounded: Tensor

    def setup(self) -> None:
        config = self.model_config
        self.distribution = distribution(self.action_space)
        self.relaxed = relaxed(self.action_space)
        self.encoder = Encoder(
            self.observation_space, config["hidden"], config.get("convolutions", ()), config.get("normalize", False)
        )
        # A first action in the middle of the bounds, where tanh has its steepest slope, or close to uniform.
        self.head = linear(self.encoder.width, self.distribution.outputs, gain=0.01)
        self.is_continuous = isinstance(self.distribution, Gaussian)
        self.register_buffer("deviation", torch.tensor(1.0))
        self.register_buffer("is_bounded", _are_bounded(self.action_space), persistent=False)

    @property
    def exploration(self) -> float:
        """The deviation of the exploration noise, in raw units."""
        return float(self.deviation)

    @exploration.setter
    def exploration(self, deviation: float) -> None:
        self.deviation.fill_(max(deviation, SMALLEST_DEVIATION))

    def answers(self, observations: dict[str, Tensor]) -> Tensor:
        """(B, d) of the head: logits that no mask has touched, or numbers before they are squashed."""
        return self.head(self.encoder(observations))

    def dist_inputs(self, answers: Tensor, observations: dict[str, Tensor]) -> Tensor:
        """Those of the distribution, (B, d) or, of a Box, (B, 2 m)."""
        if self.is_continuous:
            means = torch.where(self.is_bounded, torch.tanh(answers), answers)
            return torch.cat([means, self.deviation.log().expand_as(means)], dim=-1)
        if ACTION_MASK in observations:
            return torch.where(observations[ACTION_MASK].flatten(1).bool(), answers, MASKED)
        return answers

    def act(self, observations: dict[str, Tensor], temperature: float) -> tuple[Tensor, Tensor]:
        """Actions as a critic takes them, (B, width), through which gradients pass, and `answers`."""
        answers = self.answers(observations)
        return self.relaxed.sample(self.dist_inputs(answers, observations), temperature), answers

    def _forward(self, batch: dict[str, dict[str, Tensor]], **_: object) -> dict[str, Tensor]:
        observations = batch[Columns.OBS]
        return {Columns.ACTION_DIST_INPUTS: self.dist_inputs(self.answers(observations), observations)}


def _are_bounded(space: gymnasium.Space) -> Tensor:
    """(m,) bool: the elements of a Box that have two bounds; of other spaces none."""
    if not isinstance(space, gymnasium.spaces.Box):
        return torch.zeros(0, dtype=torch.bool)
    return torch.as_tensor(np.ravel(np.isfinite(space.low) & np.isfinite(space.high)))
