"""Discrete soft actor-critic with twin critics: Christodoulou, 2019, arXiv 1910.07207."""

from collections.abc import Collection, Mapping

import torch
from pydantic import Field
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from torch import Tensor, nn

from league.config.off_policy import ExplorationConfig, OffPolicyConfig
from league.errors import ConfigError
from league.interface import Interface
from league.spaces import Discrete
from training.algorithms.metrics import OFF_POLICY_METRICS
from training.algorithms.off_policy import OffPolicy
from training.learners.off_policy import OffPolicyLearner, ReplayBatch, ReplayLoss, bootstrapped_returns
from training.modules.actor_critic import ActorCritic
from training.modules.encoder import Encoder
from training.modules.own_network import OwnNetwork
from training.replay_buffer import DISCOUNTS, NEXT, subcolumns
from training.sampling.closed_transitions import ACTIONS, OBSERVATIONS, REWARDS, TERMINATED

CRITICS = ".critics"
"""Follows the policy's id in the name of its critics."""


class SACConfig(OffPolicyConfig):
    """The section `training`."""

    temperature: float = Field(default=0.05, gt=0)
    """α, the weight of the entropy."""
    target_every: int = Field(default=1, ge=1)
    target_rate: float = Field(default=0.005, gt=0, le=1)
    exploration: ExplorationConfig = ExplorationConfig(initial=0.0, final=0.0)
    """None: actions are sampled from the policy."""


class SACLearner(OffPolicyLearner):
    """The keys of buffers and losses are policy ids."""

    def extra_networks(self) -> dict[str, nn.Module]:
        return {policy + CRITICS: self._critics(module) for policy, module in self.module.items()}

    def _critics(self, module: ActorCritic) -> nn.ModuleList:
        """Create two networks from observations to the values of all actions."""
        encoders = (module.new_encoder() for _ in range(2))
        return nn.ModuleList(
            nn.Sequential(encoder, nn.Linear(encoder.width, module.distribution.outputs)) for encoder in encoders
        )

    def losses(self, batches: Mapping[str, ReplayBatch], learning: Collection[str]) -> dict[str, ReplayLoss]:  # noqa: ARG002
        return {policy: self._loss(policy, batch) for policy, batch in batches.items()}

    def _loss(self, policy: str, batch: ReplayBatch) -> ReplayLoss:
        assert isinstance(self.settings, SACConfig)
        rows, temperature = batch.rows, self.settings.temperature
        observations, following = subcolumns(rows, OBSERVATIONS), subcolumns(rows, NEXT + OBSERVATIONS)
        for part in (*self.networks[policy].modules(), *self.networks[policy + CRITICS].modules()):
            if isinstance(part, Encoder | OwnNetwork):
                part.update_statistics(observations)
        with torch.no_grad():
            log_p = self._log_p(policy, following)
            least = self._values(self.targets, policy, following).amin(0)
            next_values = (log_p.exp() * (least - temperature * log_p)).sum(-1)
            targets = bootstrapped_returns(rows[REWARDS], rows[DISCOUNTS], rows[TERMINATED], next_values)
        values = self._values(self.networks, policy, observations)
        action_values = values.take_along_dim(rows[ACTIONS].long().view(1, -1, 1), dim=-1).squeeze(-1)
        errors = action_values - targets
        log_p = self._log_p(policy, observations)
        # The gradient of the actor's loss does not reach the critics.
        actor_loss = (log_p.exp() * (temperature * log_p - values.detach().amin(0))).sum(-1).mean()
        return ReplayLoss(
            total=(batch.weights * errors.square().mean(0)).mean() + actor_loss,
            errors=errors.detach().abs().mean(0),
            networks=(policy, policy + CRITICS),
            statistics={
                "policy_loss": actor_loss,
                "value": action_values.mean(),
                "error": errors.abs().mean(),
                "policy_entropy": -(log_p.exp() * log_p).sum(-1).mean(),
            },
        )

    def _values(self, networks: Mapping[str, nn.Module], policy: str, observations: dict[str, Tensor]) -> Tensor:
        """Return what both critics answer for all actions, (2, k, n)."""
        critics = networks[policy + CRITICS]
        assert isinstance(critics, nn.ModuleList)
        return torch.stack([critic(observations) for critic in critics])

    def _log_p(self, policy: str, observations: dict[str, Tensor]) -> Tensor:
        """Return the log-probabilities of all actions, (k, n)."""
        actor = self.networks[policy]
        assert isinstance(actor, ActorCritic)
        return actor.policy_outputs(actor.encoder(observations), observations)["action_dist_inputs"].log_softmax(-1)


class SAC(OffPolicy):
    """Each policy learns from its own buffer."""

    settings_class = SACConfig
    module_class = ActorCritic
    learner_class = SACLearner
    curves = OFF_POLICY_METRICS | {"policy_loss": "policy_loss", "policy_entropy": "policy_entropy"}

    @classmethod
    def module_spec(cls, settings: SACConfig, interface: Interface) -> MultiRLModuleSpec:
        """Raises ConfigError for actions that are not Discrete."""
        for policy in interface.policy_ids:
            if not isinstance(interface.of_policy(policy).action, Discrete):
                raise ConfigError(f"policies.{policy}: expected Discrete actions")
        return super().module_spec(settings, interface)
