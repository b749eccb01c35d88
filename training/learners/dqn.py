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
        network.encoder.update_statistics({name: column[counted] for name, column in observations.items()})
        hidden, after = self._hidden(network, batch.rows)
        outputs = _chosen(network.head_outputs(observations, noise=True, hidden=hidden), actions)
        compare = self._values if network.atoms is None else self._atoms
        errors = compare(policy, batch, outputs, after)
        values = outputs if network.atoms is None else (outputs.detach().softmax(-1) * network.atoms).sum(-1)
        if network.atoms is None:
            losses = nn.functional.smooth_l1_loss(errors, torch.zeros_like(errors), reduction="none")
        else:
            losses = errors
        return ReplayLoss(
            total=(batch.weights * losses)[counted].mean(),
            errors=errors.abs(),
            networks=(policy,),
            statistics={"value": values[counted].mean(), "error": errors[counted].abs().mean()},
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

    def _values(self, policy: str, batch: ReplayBatch, taken: Tensor, after: Tensor | None) -> Tensor:
        """Return the temporal differences, (k,). after: hidden states at the next observations."""
        with torch.no_grad():
            rows, (best_actions, answers) = batch.rows, self._next(policy, batch, after)
            targets = bootstrapped_returns(
                rows[REWARDS], rows[DISCOUNTS], rows[TERMINATED], _chosen(answers, best_actions)
            )
        return taken - targets

    def _atoms(self, policy: str, batch: ReplayBatch, taken: Tensor, after: Tensor | None) -> Tensor:
        """Return the cross-entropies between the projected target distribution and the network's, (k,)."""
        network, rows = self.networks[policy], batch.rows
        assert isinstance(network, QNetwork)
        with torch.no_grad():
            best_actions, answers = self._next(policy, batch, after)
            following = _chosen(answers, best_actions).softmax(-1)
            targets = project_distribution(following, network.atoms, rows[REWARDS], rows[DISCOUNTS], rows[TERMINATED])
        return -(targets * taken.log_softmax(-1)).sum(-1)

    def _next(self, policy: str, batch: ReplayBatch, after: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the next actions, (k,), and the target network's outputs."""
        network, target = self.networks[policy], self.targets[policy]
        assert isinstance(network, QNetwork)
        assert isinstance(target, QNetwork)
        assert isinstance(self.settings, DQNConfig)
        observations = subcolumns(batch.rows, NEXT + OBSERVATIONS)
        answers = target.head_outputs(observations, noise=True, hidden=self._hidden(target, batch.rows)[1])
        online = None
        if self.settings.double:
            online = network.expected(network.head_outputs(observations, noise=True, hidden=after))
        return next_actions(online, target.expected(answers), _flat_mask(observations.get(ACTION_MASK))), answers


def _chosen(answers: Tensor, actions: Tensor) -> Tensor:
    return answers[torch.arange(len(actions)), actions]


def _flat_mask(mask: Tensor | None) -> Tensor | None:
    return None if mask is None else mask.flatten(1)
