"""The DQN learner: double Q-learning and distributional targets on each policy's own transitions, or on sequences."""

from collections.abc import Collection, Mapping

import torch
from torch import Tensor, nn

from league.config.off_policy import DQNConfig
from league.spaces import ACTION_MASK
from training.learners.off_policy import (
    OffPolicyLearner,
    ReplayBatch,
    ReplayLoss,
    bootstrapped_returns,
    next_actions,
    project_distribution,
)
from training.modules.q_network import QNetwork
from training.replay_buffer import DISCOUNTS, NEXT, subcolumns
from training.sampling.closed_transitions import ACTIONS, OBSERVATIONS, RECURRENT_STATE, REWARDS, TERMINATED

Hidden = tuple[Tensor | None, Tensor | None]
"""Hidden states (k, width) of a recurrent network at the observations and at the next ones."""
NOT_RECURRENT: Hidden = None, None


class DQNLearner(OffPolicyLearner):
    """The keys of buffers, losses and optimisers are policy ids."""

    def losses(self, batches: Mapping[str, ReplayBatch], learning: Collection[str]) -> dict[str, ReplayLoss]:  # noqa: ARG002
        return {policy: self._loss(policy, batch) for policy, batch in batches.items()}

    def _loss(self, policy: str, batch: ReplayBatch) -> ReplayLoss:
        network = self.networks[policy]
        assert isinstance(network, QNetwork)
        observations, actions = subcolumns(batch.rows, OBSERVATIONS), batch.rows[ACTIONS]
        counted = batch.weights > 0
        network.encoder.update_statistics(observations, counted)
        hidden, after = self._hidden(network, batch.rows)
        outputs = _chosen(network.head_outputs(observations, noise=True, hidden=hidden), actions)
        rewards, discounts, terminated = (batch.rows[name] for name in (REWARDS, DISCOUNTS, TERMINATED))
        with torch.no_grad():
            following = self._following(policy, batch, after)
            if network.atoms is None:
                targets = bootstrapped_returns(rewards, discounts, terminated, following)
            else:
                targets = project_distribution(following.softmax(-1), network.atoms, rewards, discounts, terminated)
        if network.atoms is None:
            values, errors = outputs, outputs - targets
            losses = nn.functional.smooth_l1_loss(errors, torch.zeros_like(errors), reduction="none")
        else:
            values = (outputs.detach().softmax(-1) * network.atoms).sum(-1)
            losses = errors = -(targets * outputs.log_softmax(-1)).sum(-1)  # cross-entropies
        number, sizes = counted.sum(), errors.detach().abs()
        return ReplayLoss(
            total=(batch.weights * losses).sum() / number,
            errors=sizes,
            networks=(policy,),
            statistics={
                "value": (values.detach() * counted).sum() / number,
                "error": (sizes * counted).sum() / number,
            },
        )

    def _hidden(self, network: QNetwork, rows: Mapping[str, Tensor]) -> Hidden:
        """Unroll a recurrent network over its sequences, from the states that were stored when the agents acted.

        There are no gradients through the hidden states at next observations.
        """
        assert isinstance(self.settings, DQNConfig)
        if self.settings.recurrence is None:
            return NOT_RECURRENT
        state, actions = subcolumns(rows, RECURRENT_STATE), rows[ACTIONS]
        hidden = network.hidden_states(
            subcolumns(rows, OBSERVATIONS), state, actions, self.settings.recurrence.sequence
        )
        with torch.no_grad():
            return hidden, network.hidden_after(subcolumns(rows, NEXT + OBSERVATIONS), actions, hidden)

    def _following(self, policy: str, batch: ReplayBatch, after: Tensor | None) -> Tensor:
        """Return the target network's outputs for the next actions: values (k,), or logits (k, atoms).

        after: hidden states at the next observations.
        """
        network, target = self.networks[policy], self.targets[policy]
        assert isinstance(network, QNetwork)
        assert isinstance(target, QNetwork)
        assert isinstance(self.settings, DQNConfig)
        observations = subcolumns(batch.rows, NEXT + OBSERVATIONS)
        answers = target.head_outputs(observations, noise=True, hidden=self._hidden(target, batch.rows)[1])
        online = None
        if self.settings.double:
            online = network.expected(network.head_outputs(observations, noise=True, hidden=after))
        mask = observations[ACTION_MASK].flatten(1) if ACTION_MASK in observations else None
        return _chosen(answers, next_actions(online, target.expected(answers), mask))


def _chosen(answers: Tensor, actions: Tensor) -> Tensor:
    """Return the answers (k, n, …) for actions (k,)."""
    return answers.take_along_dim(actions.reshape(-1, *[1] * (answers.ndim - 1)), dim=1).squeeze(1)
