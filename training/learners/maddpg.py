"""MADDPG's learner: for each policy a critic step and an actor step, then all targets follow.

Lowe et al., 2017, arXiv 1706.02275, algorithm 1. Each network has an optimiser of its own: a critic's loss moves the
critic alone, and an actor's loss, which runs through the critic, the actor alone.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from league.training_config import MADDPGConfig
from training.learners.maddpg_loss import actor_loss, critic_loss, td_target
from training.learners.off_policy import Batch, OffPolicyLearner
from training.modules.actor import Actor
from training.modules.critic import Critic
from training.replay import DISCOUNTS, NEXT, Sample, names
from training.sampling.closed import ACTIONS, OBSERVATIONS, PRESENT, REWARDS, TERMINATED
from training.sampling.env_runner import module_spaces

Observed = dict[str, Tensor]
"""ONNX input name → (B, …)."""


@dataclass(frozen=True, slots=True)
class Place:
    """An agent: its policy, and its number among that policy's agents."""

    policy: str
    number: int


Order = list[list[Place]]
"""For each agent of a policy, whom its critic sees, itself first."""


def critic_of(policy: str) -> str:
    """The name of a policy's critic among the learner's networks; no policy has a dot in its id."""
    return f"{policy}.critic"


class MADDPGLearner(OffPolicyLearner):
    """Is given samples of joint transitions, one for each policy that learns."""

    settings: MADDPGConfig

    def extra_networks(self) -> dict[str, nn.Module]:
        """The critics. Each serves all agents of its policy, which take the first place in turn; as the others of one
        policy stand side by side behind it, a place is always of the same spaces."""
        by_policy = list(self.interface.policies.values())
        self._agents = [
            Place(policy, i) for policy in self.interface.policy_ids for i in range(by_policy.count(policy))
        ]
        return {critic_of(policy): self._critic(Place(policy, 0)) for policy in self.interface.policy_ids}

    def learn(self, samples: Mapping[str, Sample], learning: Collection[str]) -> dict[str, NDArray]:
        """A step of the critics and actors of `learning`. samples: policy id → its own draw of joint transitions."""
        errors = {
            policy: self._learn(policy, self.batch(samples[policy])).cpu().numpy()
            for policy in self.interface.policy_ids
            if policy in learning
        }
        self.follow()
        return errors

    def explore(self, deviation: float) -> None:
        """Let the policies' graphs explore as much as the runners do now."""
        for actor in self.module.values():
            actor.exploration = deviation

    def _learn(self, policy: str, batch: Batch) -> Tensor:
        """Returns |TD error| of each transition, the largest of the policy's agents, (k,)."""
        rows = batch.rows
        order = [self._seen(place) for place in self._agents if place.policy == policy]
        present = rows[f"{PRESENT}/{policy}"].T.float()
        # Agents that are not there count nothing, the others accordingly more.
        share = (present / present.mean().clamp_min(1e-8)).flatten()
        weights = share * batch.weights.repeat(len(order))
        targets = self._targets(policy, batch, order)
        seen, done = self._situation(rows, order)
        critic = self._critic_of(policy)
        if self.settings.normalize_observations:
            self._actor_of(policy).encoder.update_statistics(seen[0])
            critic.update_statistics(seen)
        values = critic(seen, done)
        loss = critic_loss(values, targets, weights)
        critic_norm = self.descend(loss, [critic_of(policy)])[critic_of(policy)]
        policy_loss = self._policy_loss(policy, seen, done, share)
        norm = self.descend(policy_loss, [policy])[policy]
        errors = (values.detach() - targets).abs() * present.flatten()
        self.note(policy, loss=loss, value=values.mean(), error=errors.mean(), critic_gradient_norm=critic_norm)
        self.note(policy, policy_loss=policy_loss, gradient_norm=norm)
        return errors.reshape(len(order), -1).amax(0)

    def _policy_loss(self, policy: str, seen: list[Observed], done: list[Tensor], share: Tensor) -> Tensor:
        """Of actions that the actor takes now in the first place; those of the other agents are as they were."""
        action, answers = self._actor_of(policy).act(seen[0], self.settings.temperature)
        values = self._critic_of(policy)(seen, [action, *done[1:]])
        return actor_loss(values, answers, self.settings.regularization, share)

    @torch.no_grad()
    def _targets(self, policy: str, batch: Batch, order: Order) -> Tensor:
        rows = batch.rows
        seen = {place: _observed(rows, NEXT + OBSERVATIONS, place) for place in _all(order)}
        actions = {}
        for place, observed in seen.items():
            actor = self.targets[place.policy]
            assert isinstance(actor, Actor)
            goes_on = _of(rows, PRESENT, place) & ~_of(rows, TERMINATED, place)
            actions[place] = actor.act(observed, self.settings.temperature)[0] * goes_on.unsqueeze(-1)
        values = self.targets[critic_of(policy)](*_arranged(order, seen, actions))
        rewards, terminated = (rows[f"{head}/{policy}"].T.flatten() for head in (REWARDS, TERMINATED))
        return td_target(rewards, values, terminated, rows[DISCOUNTS].repeat(len(order)))

    def _situation(self, rows: Mapping[str, Tensor], order: Order) -> tuple[list[Observed], list[Tensor]]:
        """What a critic takes: observations and actions of each place of `order`, the policy's agents one behind
        another. Agents that are not there have done nothing."""
        places = _all(order)
        seen = {place: _observed(rows, OBSERVATIONS, place) for place in places}
        done = {
            place: self._actor_of(place.policy).relaxed.encode(_of(rows, ACTIONS, place))
            * _of(rows, PRESENT, place).unsqueeze(-1)
            for place in places
        }
        return _arranged(order, seen, done)

    def _actor_of(self, policy: str) -> Actor:
        actor = self.networks[policy]
        assert isinstance(actor, Actor)
        return actor

    def _critic_of(self, policy: str) -> Critic:
        critic = self.networks[critic_of(policy)]
        assert isinstance(critic, Critic)
        return critic

    def _seen(self, own: Place) -> list[Place]:
        if self.settings.critic == "own":
            return [own]
        return [own, *(place for place in self._agents if place != own)]

    def _critic(self, own: Place) -> Critic:
        spaces = [module_spaces(self.interface, place.policy) for place in self._seen(own)]
        layers = [(layer.filters, layer.kernel, layer.stride) for layer in self.settings.convolutions]
        return Critic(
            [seen for seen, _ in spaces],
            [acted for _, acted in spaces],
            self.settings.hidden,
            layers,
            self.settings.normalize_observations,
        )


def _all(order: Order) -> Iterable[Place]:
    return dict.fromkeys(place for seen in order for place in seen)


def _of(rows: Mapping[str, Tensor], head: str, place: Place) -> Tensor:
    return rows[f"{head}/{place.policy}"][:, place.number]


def _observed(rows: Mapping[str, Tensor], head: str, place: Place) -> Observed:
    return {name: column[:, place.number] for name, column in names(rows, f"{head}/{place.policy}").items()}


def _arranged(
    order: Order, seen: Mapping[Place, Observed], done: Mapping[Place, Tensor]
) -> tuple[list[Observed], list[Tensor]]:
    """What a critic takes, a place at a time: of k rows and n agents of its policy (n k, …) each."""
    observations, actions = [], []
    for places in zip(*order, strict=True):
        observations.append({name: _stacked([seen[place][name] for place in places]) for name in seen[places[0]]})
        actions.append(_stacked([done[place] for place in places]))
    return observations, actions


def _stacked(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts)
