"""The MADDPG learner: centralised critics and decentralised actors.

Lowe et al., 2017, arXiv 1706.02275, algorithm 1. Each network has its own optimiser: a critic's loss updates the critic
only, and an actor's loss, computed through the critic, the actor only.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from league.config.off_policy import MADDPGConfig
from training.learners.off_policy import OffPolicyLearner, ReplayBatch, bootstrapped_returns
from training.modules.maddpg import Actor, Critic
from training.replay_buffer import DISCOUNTS, NEXT, subcolumns
from training.sampling.closed_transitions import ACTIONS, JOINT, OBSERVATIONS, PRESENT, REWARDS, TERMINATED
from training.sampling.env_runner import module_spaces


def critic_loss(values: Tensor, targets: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return mean((Q(x, a_1 … a_N) − y)²), equation 6. weights: (B,), importance of each row."""
    assert values.shape == targets.shape
    errors = (values - targets).square()
    return (errors if weights is None else weights * errors).mean()


def actor_loss(values: Tensor, answers: Tensor, regularization: float, weights: Tensor | None = None) -> Tensor:
    """Return −mean(Q(x, a_1 … μ_i(o_i) … a_N)) + λ mean(outputs²), whose gradient is that of equation 5.

    Args:
        values: (B,), differentiable in the agent's own action only.
        answers: (B, d), the actor's outputs before masks and bounds. The second term keeps them small, as in the
            authors' implementation (openai/maddpg, λ = 0.001).
        regularization: λ.
        weights: (B,), importance of each row.
    """
    value = values if weights is None else weights * values
    return regularization * answers.square().mean() - value.mean()


Observations = dict[str, Tensor]
"""ONNX input name → (B, …)."""


@dataclass(frozen=True, slots=True)
class AgentSlot:
    """An agent: its policy, and its index among that policy's agents."""

    policy: str
    number: int


CriticAgents = list[list[AgentSlot]]
"""For each agent of a policy: the agents that its critic takes, itself first."""


def critic_name(policy: str) -> str:
    """Return the name of a policy's critic among the learner's networks; policy ids contain no dot."""
    return f"{policy}.critic"


class MADDPGLearner(OffPolicyLearner):
    """Learns from joint transitions; the rows of a step are divided among the learning policies."""

    settings: MADDPGConfig

    def extra_networks(self) -> dict[str, nn.Module]:
        """Return the critics, one per policy.

        The agents of a policy share its critic and take the first position in turn. All positions have fixed spaces,
        since the other agents of one policy are adjacent.
        """
        by_policy = list(self.interface.policies.values())
        self._agents = [
            AgentSlot(policy, i) for policy in self.interface.policy_ids for i in range(by_policy.count(policy))
        ]
        layers = [(layer.filters, layer.kernel, layer.stride) for layer in self.settings.convolutions]
        critics: dict[str, nn.Module] = {}
        for policy in self.interface.policy_ids:
            spaces = [
                module_spaces(self.interface, place.policy) for place in self._critic_agents(AgentSlot(policy, 0))
            ]
            critics[critic_name(policy)] = Critic(
                [observation for observation, _ in spaces],
                [action for _, action in spaces],
                self.settings.hidden,
                layers,
                self.settings.normalize_observations,
                self.settings.channels,
            )
        return critics

    def step(self, batches: Mapping[str, ReplayBatch], learning: Collection[str]) -> dict[str, Tensor]:
        """Update the critics and actors of `learning`, each on its own part of the joint transitions."""
        policies = [policy for policy in self.interface.policy_ids if policy in learning]
        parts = zip(policies, batches[JOINT].split(len(policies)), strict=True)
        return {JOINT: torch.cat([self._learn(policy, batch) for policy, batch in parts])}

    def set_exploration(self, deviation: float) -> None:
        """Store the runners' current noise deviation in the actors, from where it is exported."""
        for actor in self.module.values():
            actor.exploration = deviation

    def _learn(self, policy: str, batch: ReplayBatch) -> Tensor:
        """Update one policy; return |TD error| of each transition, the maximum over the policy's agents, (k,)."""
        rows = batch.rows
        order = [self._critic_agents(place) for place in self._agents if place.policy == policy]
        present = rows[f"{PRESENT}/{policy}"].T.float()
        # Absent agents have weight 0, and the others correspondingly more.
        share = (present / present.mean().clamp_min(1e-8)).flatten()
        weights = share * batch.weights.repeat(len(order))
        targets = self._targets(policy, batch, order)
        observations, actions = self._critic_inputs(rows, order)
        critic = self.networks[critic_name(policy)]
        assert isinstance(critic, Critic)
        if self.settings.normalize_observations:
            self._actor_of(policy).encoder.update_statistics(observations[0])
            critic.update_statistics(observations)
        values = critic(observations, actions)
        loss = critic_loss(values, targets, weights)
        critic_norm = self.gradient_step(loss, [critic_name(policy)])[critic_name(policy)]
        policy_loss = self.policy_loss(policy, observations, actions, share)
        norm = self.gradient_step(policy_loss, [policy])[policy]
        errors = (values.detach() - targets).abs() * present.flatten()
        self.log_statistics(
            policy,
            loss=loss,
            value=values.mean(),
            error=errors.mean(),
            critic_gradient_norm=critic_norm,
            policy_loss=policy_loss,
            gradient_norm=norm,
        )
        return errors.reshape(len(order), -1).amax(0)

    def policy_loss(
        self, policy: str, observations: list[Observations], actions: list[Tensor], share: Tensor
    ) -> Tensor:
        """Return the actor's loss with its current actions in the first position, and the other agents' of the sample.

        observations, actions: by position, see `_critic_inputs`. share: (k,), the weight of each row.
        """
        action, answers = self._actor_of(policy).act(observations[0], self.settings.temperature)
        values = self.networks[critic_name(policy)](observations, [action, *actions[1:]])
        return actor_loss(values, answers, self.settings.regularization, share)

    @torch.no_grad()
    def _targets(self, policy: str, batch: ReplayBatch, order: CriticAgents) -> Tensor:
        rows = batch.rows
        observations = {place: _agent_observations(rows, NEXT + OBSERVATIONS, place) for place in _distinct(order)}
        actions = {}
        for place, observed in observations.items():
            actor = self.targets[place.policy]
            assert isinstance(actor, Actor)
            goes_on = _agent_column(rows, PRESENT, place) & ~_agent_column(rows, TERMINATED, place)
            actions[place] = actor.act(observed, self.settings.temperature)[0] * goes_on.unsqueeze(-1)
        values = self.targets[critic_name(policy)](*_stack_by_position(order, observations, actions))
        rewards, terminated = (rows[f"{head}/{policy}"].T.flatten() for head in (REWARDS, TERMINATED))
        return bootstrapped_returns(rewards, rows[DISCOUNTS].repeat(len(order)), terminated, values)

    def _critic_inputs(
        self, rows: Mapping[str, Tensor], order: CriticAgents
    ) -> tuple[list[Observations], list[Tensor]]:
        """Return observations and actions of each position, concatenated over the policy's agents; absent agents act
        0."""
        places = _distinct(order)
        observations = {place: _agent_observations(rows, OBSERVATIONS, place) for place in places}
        actions = {
            place: self._actor_of(place.policy).relaxed.encode(_agent_column(rows, ACTIONS, place))
            * _agent_column(rows, PRESENT, place).unsqueeze(-1)
            for place in places
        }
        return _stack_by_position(order, observations, actions)

    def _actor_of(self, policy: str) -> Actor:
        actor = self.networks[policy]
        assert isinstance(actor, Actor)
        return actor

    def _critic_agents(self, own: AgentSlot) -> list[AgentSlot]:
        if self.settings.critic == "own":
            return [own]
        return [own, *(place for place in self._agents if place != own)]


def _distinct(order: CriticAgents) -> Iterable[AgentSlot]:
    return dict.fromkeys(place for agents in order for place in agents)


def _agent_column(rows: Mapping[str, Tensor], head: str, place: AgentSlot) -> Tensor:
    return rows[f"{head}/{place.policy}"][:, place.number]


def _agent_observations(rows: Mapping[str, Tensor], head: str, place: AgentSlot) -> Observations:
    return {name: column[:, place.number] for name, column in subcolumns(rows, f"{head}/{place.policy}").items()}


def _stack_by_position(
    order: CriticAgents, seen: Mapping[AgentSlot, Observations], done: Mapping[AgentSlot, Tensor]
) -> tuple[list[Observations], list[Tensor]]:
    """Return the critic's inputs by position; for k rows and n agents of the policy, (n k, …) each."""
    observations, actions = [], []
    for places in zip(*order, strict=True):
        observations.append({name: _concatenated([seen[place][name] for place in places]) for name in seen[places[0]]})
        actions.append(_concatenated([done[place] for place in places]))
    return observations, actions


def _concatenated(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts)
