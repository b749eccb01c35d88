"""Actor-critic networks for all observation and action spaces, optionally with an encoder that policies share."""

from typing import Any

import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModule
from torch import Tensor, nn

from league.spaces import ACTION_MASK
from training.modules.distributions import TorchGaussian, torch_distribution
from training.modules.encoder import Encoder, linear
from training.modules.own_network import OwnNetwork
from training.modules.policy_module import PolicyModule, mask_illegal
from training.modules.recurrent import LSTMLayer, State

INITIAL_LOG_DEVIATION = -0.5
"""For actions of a Box; exp(-0.5) = 0.6 explores most of [-1, 1] without frequent clipping."""
LOG_DEVIATION_BOUNDS = -5.0, 2.0


class ActorCritic(PolicyModule, ValueFunctionAPI):
    """Encoder, optional LSTM, policy head and value head.

    Observations are dictionaries ONNX input name → tensor (B, …) in the environment's dtype; `action_mask` (B, d) of 0
    and 1 is optional. `observation_space` is the Dict of those names. model_config: `hidden`, widths of the encoder;
    `convolutions`, (filters, kernel, stride) each; `channels`, their axis in images, or None; `recurrence`, width
    of the LSTM or None; `normalize`.

    Inference takes one step: (B, …) and, if recurrent, the state (B, width) under Columns.STATE_IN. A recurrent
    `forward_train` takes concatenated sequences, their lengths (S,) under Columns.SEQ_LENS and initial states (S,
    width).
    """

    def setup(self) -> None:
        config = self.model_config
        self.distribution = torch_distribution(self.action_space)
        self.encoder = self.new_encoder()
        width = self.encoder.width
        self.recurrent = LSTMLayer(width, config["recurrence"]) if config.get("recurrence") else None
        if self.recurrent is not None:
            width = self.recurrent.width
        # A nearly uniform initial policy, as in Andrychowicz et al. (2021), "What matters for on-policy deep
        # actor-critic methods?", section 3.2.
        self.policy_head = linear(width, self.distribution.outputs, gain=0.01)
        self.value_head = linear(width, 1, gain=1.0)
        self.log_deviations = (
            nn.Parameter(torch.full((self.distribution.m,), INITIAL_LOG_DEVIATION))
            if isinstance(self.distribution, TorchGaussian)
            else None
        )

    def get_initial_state(self) -> dict[str, NDArray]:
        """Return the state before an episode's first step, key → (width,); empty if not recurrent."""
        return {} if self.recurrent is None else self.recurrent.initial_state()

    def update_statistics(self, observations: dict[str, Tensor]) -> None:
        """Update the running statistics of observations, if they are normalised."""
        self.encoder.update_statistics(observations)

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        embeddings, state = self._step(batch)
        acted: dict[str, Any] = self.policy_outputs(embeddings, batch[Columns.OBS])
        return acted | {Columns.STATE_OUT: state} if state else acted

    def _forward_train(self, batch: dict[str, Any], **_: Any) -> dict[str, Tensor]:
        embeddings = self.encoder(batch[Columns.OBS])
        if self.recurrent is not None:
            embeddings = self.recurrent.unroll(embeddings, batch[Columns.SEQ_LENS], batch[Columns.STATE_IN])
        return self.train_outputs(embeddings, batch[Columns.OBS])

    def policy_outputs(self, embeddings: Tensor, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the distribution inputs, (B, d), for encoded rows."""
        return {Columns.ACTION_DIST_INPUTS: self._dist_inputs(self.policy_head(embeddings), observations)}

    def train_outputs(self, embeddings: Tensor, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the distribution inputs, (B, d), and values, (B,), for encoded rows."""
        # Both heads in one product, whose time hardly depends on the number of outputs.
        weight = torch.cat([self.policy_head.weight, self.value_head.weight])
        bias = torch.cat([self.policy_head.bias, self.value_head.bias])
        answers, values = nn.functional.linear(embeddings, weight, bias).split([self.distribution.outputs, 1], dim=-1)
        return {
            Columns.ACTION_DIST_INPUTS: self._dist_inputs(answers, observations),
            Columns.VF_PREDS: values.squeeze(-1),
        }

    def _dist_inputs(self, answers: Tensor, observations: dict[str, Tensor]) -> Tensor:
        if self.log_deviations is None:
            return mask_illegal(answers, observations)
        deviations = self.log_deviations.clamp(*LOG_DEVIATION_BOUNDS).expand_as(answers)
        return torch.cat([answers, deviations], dim=-1)

    def compute_values(self, batch: dict[str, Any], embeddings: Tensor | None = None) -> Tensor:
        """Return the values, (B,), of the observations in `batch`, one step each."""
        return self.value_step(batch)[0] if embeddings is None else self.value_head(embeddings).squeeze(-1)

    def value_step(self, batch: dict[str, Any]) -> tuple[Tensor, State]:
        """Return values as `compute_values` does, and the state after the step, empty if not recurrent."""
        embeddings, state = self._step(batch)
        return self.value_head(embeddings).squeeze(-1), state

    def _step(self, batch: dict[str, Any]) -> tuple[Tensor, State]:
        embeddings = self.encoder(batch[Columns.OBS])
        return (embeddings, {}) if self.recurrent is None else self.recurrent.step(embeddings, batch[Columns.STATE_IN])


class SharedEncoder(MultiRLModule):
    """ActorCritics that share one encoder, which runs once per pass on the rows of all policies.

    `module[policy]` also acts, saves and exports on its own, with the encoder included. All policies must have the same
    observation space, action masks aside.
    """

    def setup(self) -> None:
        super().setup()
        modules = list(self.values())
        for module in modules[1:]:
            module.encoder = modules[0].encoder

    @property
    def encoder(self) -> Encoder | OwnNetwork:
        """The shared encoder."""
        return next(iter(self.values())).encoder

    def _forward_train(self, batch: dict[str, Any], **_: Any) -> dict[str, dict[str, Tensor]]:
        return {
            policy: self[policy].train_outputs(embeddings, batch[policy][Columns.OBS])
            for policy, embeddings in self._encoded(batch).items()
        }

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, dict[str, Tensor]]:
        with torch.no_grad():
            return {
                policy: self[policy].policy_outputs(embeddings, batch[policy][Columns.OBS])
                for policy, embeddings in self._encoded(batch).items()
            }

    _forward_inference = _forward
    _forward_exploration = _forward

    def _encoded(self, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Return policy id → embeddings of its rows."""
        observed = {policy: columns[Columns.OBS] for policy, columns in batch.items() if policy in self}
        if not observed:
            return {}
        rows = [len(next(iter(observations.values()))) for observations in observed.values()]
        together = {
            name: torch.cat([observations[name] for observations in observed.values()])
            for name in next(iter(observed.values()))
            if name != ACTION_MASK
        }
        return dict(zip(observed, self.encoder(together).split(rows), strict=True))
