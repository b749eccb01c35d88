"""DQN's loss: each policy from its own transitions."""

from collections.abc import Collection, Mapping

import torch
from torch import Tensor, nn

from league.spaces import ACTION_MASK
from league.training_config import DQNConfig
from training.learners.off_policy import Batch, Loss, OffPolicyLearner
from training.learners.q_targets import next_actions, projected, returns
from training.modules.q_network import QNetwork
from training.replay import DISCOUNTS, NEXT, names
from training.sampling.closed import ACTIONS, OBSERVATIONS, REWARDS, TERMINATED


class DQNLearner(OffPolicyLearner):
    """Buffers, losses and optimisers are those of policy ids."""

    def losses(self, batches: Mapping[str, Batch], learning: Collection[str]) -> dict[str, Loss]:  # noqa: ARG002
        return {policy: self._loss(policy, batch) for policy, batch in batches.items()}

    def _loss(self, policy: str, batch: Batch) -> Loss:
        network = self.networks[policy]
        assert isinstance(network, QNetwork)
        observations = names(batch.rows, OBSERVATIONS)
        network.encoder.update_statistics(observations)
        actions = batch.rows[ACTIONS]
        taken = network.answers(observations, noise=True)[torch.arange(len(actions)), actions]
        errors = self._atoms(policy, batch, taken) if network.atoms is not None else self._values(policy, batch, taken)
        values = taken if network.atoms is None else (taken.detach().softmax(-1) * network.atoms).sum(-1)
        if network.atoms is None:
            losses = nn.functional.smooth_l1_loss(errors, torch.zeros_like(errors), reduction="none")
        else:
            losses = errors
        return Loss(
            total=(batch.weights * losses).mean(),
            errors=errors.abs(),
            networks=(policy,),
            statistics={"value": values.mean(), "error": errors.abs().mean()},
        )

    def _values(self, policy: str, batch: Batch, taken: Tensor) -> Tensor:
        """(k,) temporal differences."""
        with torch.no_grad():
            rows, (chosen, answers) = batch.rows, self._next(policy, batch)
            targets = returns(rows[REWARDS], rows[DISCOUNTS], rows[TERMINATED], _of(answers, chosen))
        return taken - targets

    def _atoms(self, policy: str, batch: Batch, taken: Tensor) -> Tensor:
        """(k,) cross-entropies of the projected target's distribution and the network's."""
        network, rows = self.networks[policy], batch.rows
        assert isinstance(network, QNetwork)
        with torch.no_grad():
            chosen, answers = self._next(policy, batch)
            following = _of(answers, chosen).softmax(-1)
            targets = projected(following, network.atoms, rows[REWARDS], rows[DISCOUNTS], rows[TERMINATED])
        return -(targets * taken.log_softmax(-1)).sum(-1)

    def _next(self, policy: str, batch: Batch) -> tuple[Tensor, Tensor]:
        """The next actions (k,), and the target network's answers."""
        network, target = self.networks[policy], self.targets[policy]
        assert isinstance(network, QNetwork)
        assert isinstance(target, QNetwork)
        assert isinstance(self.settings, DQNConfig)
        observations = names(batch.rows, NEXT + OBSERVATIONS)
        answers = target.answers(observations, noise=True)
        online = network.expected(network.answers(observations, noise=True)) if self.settings.double else None
        return next_actions(online, target.expected(answers), _flat(observations.get(ACTION_MASK))), answers


def _of(answers: Tensor, actions: Tensor) -> Tensor:
    return answers[torch.arange(len(actions)), actions]


def _flat(mask: Tensor | None) -> Tensor | None:
    return None if mask is None else mask.flatten(1)
