"""An actor-critic network for any observation, and any action space that a policy can have."""

from typing import Any

import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from torch import Tensor, nn

from league.spaces import ACTION_MASK
from training.modules.acting import MASKED, Acting
from training.modules.distributions import Gaussian, distribution
from training.modules.encoder import Encoder, linear
from training.modules.memory import Memory, State

FIRST_LOG_DEVIATION = -0.5
"""Of the actions of a Box; exp(-0.5) = 0.6 explores most of the span [-1, 1] without being clipped all the time."""
LOG_DEVIATIONS = -5.0, 2.0


class ActorCritic(Acting, ValueFunctionAPI):
    """Encoder, memory where asked for, a policy head and a value head.

    Observations are dictionaries ONNX input name → tensor (B, …) in the environment's dtype; `action_mask` (B, d) of
    0 and 1 is optional. `observation_space` is the Dict of those names. model_config: `hidden`, the encoder's widths;
    `convolutions`, (filters, kernel, stride) each; `recurrence`, the memory's width or None; `normalize`.

    Acting takes one step: (B, …) and, with a memory, the state (B, width) under Columns.STATE_IN. `forward_train` of a
    memory takes sequences one behind another, their lengths (S,) under Columns.SEQ_LENS and first states (S, width).
    """

    def setup(self) -> None:
        config = self.model_config
        self.distribution = distribution(self.action_space)
        self.encoder = Encoder(
            self.observation_space, config["hidden"], config.get("convolutions", ()), config.get("normalize", False)
        )
        width = self.encoder.width
        self.memory = Memory(width, config["recurrence"]) if config.get("recurrence") else None
        if self.memory is not None:
            width = self.memory.width
        # A first policy close to uniform, as in Andrychowicz et al. (2021), "What matters for on-policy deep
        # actor-critic methods?", section 3.2.
        self.policy_head = linear(width, self.distribution.outputs, gain=0.01)
        self.value_head = linear(width, 1, gain=1.0)
        self.log_deviations = (
            nn.Parameter(torch.full((self.distribution.m,), FIRST_LOG_DEVIATION))
            if isinstance(self.distribution, Gaussian)
            else None
        )

    def get_initial_state(self) -> dict[str, NDArray]:
        """The state before an episode's first step, key → (width,); empty without a memory."""
        return {} if self.memory is None else self.memory.initial_state()

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        embeddings, state = self._step(batch)
        acted: dict[str, Any] = self.act(embeddings, batch[Columns.OBS])
        return acted | {Columns.STATE_OUT: state} if state else acted

    def _forward_train(self, batch: dict[str, Any], **_: Any) -> dict[str, Tensor]:
        embeddings = self.encoder(batch[Columns.OBS])
        if self.memory is not None:
            embeddings = self.memory.unroll(embeddings, batch[Columns.SEQ_LENS], batch[Columns.STATE_IN])
        return self.heads(embeddings, batch[Columns.OBS])

    def act(self, embeddings: Tensor, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """What acting needs of rows that are encoded: inputs of the distribution, (B, d)."""
        return {Columns.ACTION_DIST_INPUTS: self._dist_inputs(embeddings, observations)}

    def heads(self, embeddings: Tensor, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """What learning needs: that, and values (B,)."""
        return self.act(embeddings, observations) | {Columns.VF_PREDS: self.value_head(embeddings).squeeze(-1)}

    def compute_values(self, batch: dict[str, Any], embeddings: Tensor | None = None) -> Tensor:
        """(B,) values of the observations in `batch`, one step each."""
        return self.value_step(batch)[0] if embeddings is None else self.value_head(embeddings).squeeze(-1)

    def value_step(self, batch: dict[str, Any]) -> tuple[Tensor, State]:
        """As compute_values, with the state after the step; empty without a memory."""
        embeddings, state = self._step(batch)
        return self.value_head(embeddings).squeeze(-1), state

    def _step(self, batch: dict[str, Any]) -> tuple[Tensor, State]:
        embeddings = self.encoder(batch[Columns.OBS])
        return (embeddings, {}) if self.memory is None else self.memory.step(embeddings, batch[Columns.STATE_IN])

    def _dist_inputs(self, embeddings: Tensor, observations: dict[str, Tensor]) -> Tensor:
        answers = self.policy_head(embeddings)
        if self.log_deviations is not None:
            return torch.cat([answers, self.log_deviations.clamp(*LOG_DEVIATIONS).expand_as(answers)], dim=-1)
        if ACTION_MASK in observations:
            return torch.where(observations[ACTION_MASK].flatten(1).bool(), answers, MASKED)
        return answers
