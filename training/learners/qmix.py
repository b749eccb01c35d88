"""QMIX's loss: the temporal difference of each team's value, from joint transitions.

Columns of the buffer stand by policy (training/sampling/closed.py). Here the agents of all policies stand beside one
another, policy by policy, (k, N), and a team is some of these columns.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from league.config import LeagueConfig
from league.interface import Interface
from league.spaces import ACTION_MASK
from league.training_config import QMIXConfig
from training.learners.off_policy import Batch, Loss, OffPolicyLearner
from training.learners.q_targets import next_actions
from training.learners.team_targets import TeamSteps
from training.modules.agent_network import AgentNetwork, Observations, flat
from training.modules.mixer import Mixer, MonotonicMixer, summed, unmixed
from training.replay import DISCOUNTS, NEXT, names
from training.sampling.closed import (
    ACTIONS,
    JOINT,
    MEMORY,
    OBSERVATIONS,
    PRESENT,
    REWARDS,
    STATE,
    TERMINATED,
    state_size,
)
from training.sampling.env_runner import LEAGUE
from training.teams import Teams, teams


@dataclass(frozen=True, slots=True)
class _Play:
    """k rows of the n agents of a policy: what they saw, what they saw next, both input name → (k, n, …); what they
    remembered, key → (k, n, width); what they did (k, n), and whether they were there."""

    seen: Observations
    coming: Observations
    memory: dict[str, Tensor]
    actions: Tensor
    present: Tensor


class QMIXLearner(OffPolicyLearner):
    """`networks`: the policies' AgentNetworks, and for QMIX a MonotonicMixer `mixer/<team>` for each team."""

    settings: QMIXConfig

    def extra_networks(self) -> dict[str, nn.Module]:
        self.teams = teams(self.settings.groups, self.interface)
        self.columns = columns(self.teams, self.interface)
        if self.settings.mixer != "qmix":
            return {}
        environment = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).environment
        size = state_size(environment, self.interface)
        width, normalize = self.settings.mixing_width, self.settings.normalize_observations
        return {
            _mixer(team): MonotonicMixer(len(members), size, width, normalize) for team, members in self.teams.items()
        }

    def losses(self, batches: Mapping[str, Batch], learning: Collection[str]) -> dict[str, Loss]:
        rows, weights = batches[JOINT].rows, batches[JOINT].weights
        chosen, following = self._values(rows, learning)
        networks = [policy for policy in self.interface.policy_ids if policy in learning]
        totals, errors, values = [], [], []
        for team, steps in self._steps(rows, learning).items():
            networks += [name for name in (_mixer(team),) if name in self.networks]
            own = self.columns[team]
            self._update_statistics(team, steps.states[weights > 0])
            mixed = steps.mixed(self.mixer(self.networks, team), chosen[:, own])
            with torch.no_grad():
                targets = steps.targets(self.mixer(self.targets, team), following[:, own])
                counted = steps.counted() & (weights > 0).unsqueeze(-1)
            differences = torch.where(counted, mixed - targets, 0.0)
            totals.append((weights.unsqueeze(-1) * differences.square()).sum() / counted.sum().clamp(min=1))
            errors.append(differences.abs().amax(-1))
            values.append(mixed[counted])
        largest = torch.stack(errors).amax(0)
        loss = Loss(
            total=torch.stack(totals).sum(),
            errors=largest,
            networks=tuple(networks),
            statistics={"value": torch.cat(values).mean(), "error": largest[weights > 0].mean()},
        )
        return {JOINT: loss}

    def _steps(self, rows: Mapping[str, Tensor], learning: Collection[str]) -> dict[str, TeamSteps]:
        """Of the teams in which somebody learns."""
        rewards, present, terminated = (self._by_agent(rows, head) for head in (REWARDS, PRESENT, TERMINATED))
        policies, together = self.interface.policies, self.settings.mixer != "none"
        discounts, states, next_states = rows[DISCOUNTS], rows[STATE], rows[NEXT + STATE]
        return {
            team: TeamSteps(
                rewards[:, own], present[:, own], terminated[:, own], discounts, states, next_states, together
            )
            for team, own in self.columns.items()
            if any(policies[agent] in learning for agent in self.teams[team])
        }

    def mixer(self, networks: Mapping[str, nn.Module], team: str) -> Mixer:
        """That of a team among `networks`, or `targets`."""
        match self.settings.mixer:
            case "qmix":
                return networks[_mixer(team)]
            case "vdn":
                return summed
        return unmixed

    def _update_statistics(self, team: str, states: Tensor) -> None:
        if isinstance(mixer := self.networks.get(_mixer(team)), MonotonicMixer):
            mixer.update_statistics(states)

    def _by_agent(self, rows: Mapping[str, Tensor], head: str) -> Tensor:
        """(k, N)"""
        return torch.cat([rows[f"{head}/{policy}"] for policy in self.interface.policy_ids], dim=1)

    def _values(self, rows: Mapping[str, Tensor], learning: Collection[str]) -> tuple[Tensor, Tensor]:
        """(k, N) values of the actions that were taken, with gradients, and of those that are best next, without."""
        taken, best = [], []
        for policy in self.interface.policy_ids:
            network, target = self.networks[policy], self.targets[policy]
            assert isinstance(network, AgentNetwork)
            assert isinstance(target, AgentNetwork)
            play = _Play(
                seen=names(rows, f"{OBSERVATIONS}/{policy}"),
                coming=names(rows, f"{NEXT}{OBSERVATIONS}/{policy}"),
                memory=names(rows, f"{MEMORY}/{policy}"),
                actions=rows[f"{ACTIONS}/{policy}"],
                present=rows[f"{PRESENT}/{policy}"],
            )
            if policy in learning:
                network.encoder.update_statistics({name: rows[play.present] for name, rows in play.seen.items()})
            values, online = self._both(network, play)
            taken.append(values.gather(-1, play.actions.unsqueeze(-1)).squeeze(-1))
            with torch.no_grad():
                _, valued = self._both(target, play)
                mask = play.coming[ACTION_MASK].flatten(2) if ACTION_MASK in play.coming else None
                chosen = next_actions(online if self.settings.double else None, valued, mask)
                best.append(valued.gather(-1, chosen.unsqueeze(-1)).squeeze(-1))
        return torch.cat(taken, dim=1), torch.cat(best, dim=1)

    def _both(self, network: AgentNetwork, play: _Play) -> tuple[Tensor, Tensor]:
        """Values of what n agents saw, (k, n, actions), and of what they saw next, without gradients."""
        if self.settings.recurrence is not None:
            return _in_sequences(network, play, self.settings.recurrence.sequence)
        values = network.values(flat(play.seen)).unflatten(0, play.present.shape)
        with torch.no_grad():
            return values, network.values(flat(play.coming)).unflatten(0, play.present.shape)


def _in_sequences(network: AgentNetwork, play: _Play, steps: int) -> tuple[Tensor, Tensor]:
    """As `_both`: rows (S · T, n, …) become T steps of S · n agents, and rows again.

    What an agent remembered before the first step is what it had when it acted (Kapturowski et al., 2019, "Recurrent
    experience replay in distributed reinforcement learning", stored state); nothing, where an episode begins.
    """
    agents = play.present.shape[1]

    def in_time(column: Tensor) -> Tensor:
        return column.unflatten(0, (-1, steps)).transpose(0, 1).flatten(1, 2)

    def in_rows(column: Tensor) -> Tensor:
        return column.unflatten(1, (-1, agents)).transpose(0, 1).flatten(0, 1)

    acted, there = in_time(play.actions), in_time(play.present)
    state = {key: in_time(column)[0] for key, column in play.memory.items()}
    seen = {name: in_time(column) for name, column in play.seen.items()}
    values, behind = network.unroll(seen, state, acted, there)
    with torch.no_grad():
        coming = flat({name: in_time(column) for name, column in play.coming.items()})
        following = network.values_after(coming, acted.flatten(), behind.flatten(0, 1))
    return in_rows(values), in_rows(following.unflatten(0, (steps, -1)))


def columns(of_teams: Teams, interface: Interface) -> dict[str, list[int]]:
    """team → where its agents stand when those of all policies stand beside one another, policy by policy."""
    order = [
        agent for policy in interface.policy_ids for agent in interface.agents if interface.policies[agent] == policy
    ]
    return {team: [order.index(agent) for agent in members] for team, members in of_teams.items()}


def _mixer(team: str) -> str:
    return f"mixer/{team}"
