"""PPO whose value function has a network of its own, so that neither of its two losses limits the other."""

from typing import Any

from ray.rllib.core.columns import Columns
from torch import Tensor

from training.algorithms.ppo import PPO
from training.modules.actor_critic import ActorCritic
from training.modules.encoder import linear
from training.modules.recurrent import State


class SeparateCritic(ActorCritic):
    """An actor and a critic without common layers. With `recurrence`, only the actor has a memory."""

    def setup(self) -> None:
        super().setup()
        self.critic = self.new_encoder()
        self.value_head = linear(self.critic.width, 1, gain=1.0)

    def update_statistics(self, observations: dict[str, Tensor]) -> None:
        """Those of both networks, if `normalize_observations` is set."""
        super().update_statistics(observations)
        self.critic.update_statistics(observations)

    def train_outputs(self, embeddings: Tensor, observations: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return what is learned: the inputs of the action distribution, (B, d), and the values, (B,)."""
        values = self.compute_values({Columns.OBS: observations})
        return self.policy_outputs(embeddings, observations) | {Columns.VF_PREDS: values}

    def compute_values(self, batch: dict[str, Any], embeddings: Tensor | None = None) -> Tensor:  # noqa: ARG002
        """Return values, (B,), also of the exported graph, which search versions use."""
        return self.value_head(self.critic(batch[Columns.OBS])).squeeze(-1)

    def value_step(self, batch: dict[str, Any]) -> tuple[Tensor, State]:
        """Return values, (B,), and the state as it was, which they do not depend on."""
        return self.compute_values(batch), batch.get(Columns.STATE_IN, {})


class SeparatePPO(PPO):
    """PPO with another module."""

    module_class = SeparateCritic
