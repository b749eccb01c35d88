"""The QMIX and VDN learner: team values mixed from agent values, and team targets.

Columns of the buffer are grouped by policy (training/sampling/closed_transitions.py). Here, the agents of all policies
are adjacent columns in the order of the policies, (k, N), and a team is a subset of them. Rashid et al., 2018.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from league.config.league import LeagueConfig
from league.config.off_policy import QMIXConfig
from league.environments.building import divide
from league.errors import ConfigError
from league.interface import Interface
from league.spaces import ACTION_MASK, Discrete
from training.learners.off_policy import OffPolicyLearner, ReplayBatch, ReplayLoss, bootstrapped_returns, next_actions
from training.modules.qmix import (
    AgentNetwork,
    Mixer,
    MonotonicMixer,
    Observations,
    flatten_leading,
    independent_mixer,
    vdn_mixer,
)
from training.replay_buffer import DISCOUNTS, NEXT, subcolumns
from training.sampling.closed_transitions import (
    ACTIONS,
    JOINT,
    OBSERVATIONS,
    PRESENT,
    RECURRENT_STATE,
    REWARDS,
    STATE,
    TERMINATED,
    state_size,
)
from training.sampling.env_runner import LEAGUE

Teams = dict[str, tuple[str, ...]]
"""group → its agents, in the order of `possible_agents`."""


def teams(groups: Mapping[str, tuple[str, ...]] | None, interface: Interface) -> Teams:
    """Return the agents of each group, or of each side if no groups are given.

    Raises ConfigError if a pattern matches no agent, or an agent matches no group, has other than Discrete actions,
    or has other spaces than the rest of its group.
    """
    if groups is None:
        team_agents = {
            group: tuple(agent for agent in interface.agents if agent in side)
            for group, side in interface.sides.items()
        }
        key = "sides"
    else:
        group_of = divide("training.groups", dict(groups), list(interface.agents))
        team_agents = {
            group: tuple(agent for agent in interface.agents if group_of[agent] == group) for group in groups
        }
        key = "training.groups"
    for group, members in team_agents.items():
        for agent in members:
            _check(f"{key}.{group}", members[0], agent, interface)
    return team_agents


def _check(where: str, first: str, agent: str, interface: Interface) -> None:
    agent_spaces, first_spaces = interface.agents[agent], interface.agents[first]
    if not isinstance(agent_spaces.action, Discrete):
        raise ConfigError(
            f"{where}: qmix needs Discrete actions, but {agent} has {agent_spaces.action!r}: use algorithm: ppo, or"
            " maddpg for continuous actions"
        )
    if agent_spaces.action != first_spaces.action:
        raise ConfigError(
            f"{where}: {first} and {agent} have different action spaces: pad them with SuperSuit's pad_action_space_v0"
        )
    if agent_spaces.observation != first_spaces.observation:
        raise ConfigError(
            f"{where}: {first} and {agent} have different observation spaces: pad them with SuperSuit's"
            " pad_observations_v0"
        )


@dataclass(frozen=True, slots=True)
class TeamSteps:
    """k joint transitions of a team of n agents.

    together: the team has one value, learned from its mean reward; otherwise each agent has its own value.
    rewards, present, terminated: (k, n). discounts: (k,), γ^m for m steps. states, next_states: (k, s).
    """

    rewards: Tensor
    present: Tensor
    terminated: Tensor
    discounts: Tensor
    states: Tensor
    next_states: Tensor
    together: bool

    def mixed(self, mixer: Mixer, values: Tensor) -> Tensor:
        """Mix the values (k, n) of the taken actions to (k, m); absent agents count 0."""
        return mixer(torch.where(self.present, values, 0.0), self.states)

    def counted(self) -> Tensor:
        """Return (k, m) bool: whether an agent was present."""
        return self.present.any(-1, keepdim=True) if self.together else self.present

    def targets(self, mixer: Mixer, following: Tensor) -> Tensor:
        """Return R + γ^m Q_tot(s', u'), (k, m), from the values (k, n) of the best next actions.

        Terminated agents count 0 in the mixture, and without remaining agents there is no bootstrap. Truncated agents
        are bootstrapped from their last observations.
        """
        goes_on = self.present & ~self.terminated
        paid, ended = self.rewards, ~goes_on
        if self.together:
            paid, ended = paid.mean(-1, keepdim=True), ended.all(-1, keepdim=True)
        later = mixer(torch.where(goes_on, following, 0.0), self.next_states)
        return bootstrapped_returns(paid, self.discounts.unsqueeze(-1), ended, later)


@dataclass(frozen=True, slots=True)
class _AgentRows:
    """k rows of the n agents of a policy.

    observations, next_observations: input name → (k, n, …). recurrent_state: key → (k, n, width). actions: (k, n).
    present: (k, n) bool.
    """

    observations: Observations
    next_observations: Observations
    recurrent_state: dict[str, Tensor]
    actions: Tensor
    present: Tensor


class QMIXLearner(OffPolicyLearner):
    """`networks`: the policies' AgentNetworks and, for QMIX, a MonotonicMixer `mixer/<team>` for each team."""

    settings: QMIXConfig

    def extra_networks(self) -> dict[str, nn.Module]:
        self.teams = teams(self.settings.groups, self.interface)
        columns = team_columns(self.teams, self.interface)
        self.columns = {team: torch.tensor(indices, device=self.device) for team, indices in columns.items()}
        if self.settings.mixer != "qmix":
            return {}
        environment = LeagueConfig.model_validate(self.config.env_config[LEAGUE]).environment
        size = state_size(environment, self.interface)
        width, normalize = self.settings.mixing_width, self.settings.normalize_observations
        return {
            _mixer_name(team): MonotonicMixer(len(members), size, width, normalize)
            for team, members in self.teams.items()
        }

    def losses(self, batches: Mapping[str, ReplayBatch], learning: Collection[str]) -> dict[str, ReplayLoss]:
        rows, weights = batches[JOINT].rows, batches[JOINT].weights
        action_values, following = self._values(rows, learning)
        networks = [policy for policy in self.interface.policy_ids if policy in learning]
        counted_rows = weights > 0
        totals, errors, values, numbers = [], [], [], []
        for team, steps in self._steps(rows, learning).items():
            networks += [name for name in (_mixer_name(team),) if name in self.networks]
            columns = self.columns[team]
            if isinstance(mixer := self.networks.get(_mixer_name(team)), MonotonicMixer):
                mixer.update_statistics(steps.states, counted_rows)
            mixed = steps.mixed(self.mixer(self.networks, team), action_values.index_select(1, columns))
            with torch.no_grad():
                targets = steps.targets(self.mixer(self.targets, team), following.index_select(1, columns))
                counted = steps.counted() & counted_rows.unsqueeze(-1)
            differences = torch.where(counted, mixed - targets, 0.0)
            numbers.append(counted.sum())
            totals.append((weights.unsqueeze(-1) * differences.square()).sum() / numbers[-1].clamp(min=1))
            errors.append(differences.detach().abs().amax(-1))
            values.append((mixed.detach() * counted).sum())
        largest = torch.stack(errors).amax(0)
        loss = ReplayLoss(
            total=torch.stack(totals).sum(),
            errors=largest,
            networks=tuple(networks),
            statistics={
                "value": torch.stack(values).sum() / torch.stack(numbers).sum().clamp(min=1),
                "error": largest.sum() / counted_rows.sum(),
            },
        )
        return {JOINT: loss}

    def _steps(self, rows: Mapping[str, Tensor], learning: Collection[str]) -> dict[str, TeamSteps]:
        """Return the steps of the teams with at least one learning policy."""
        rewards, present, terminated = (
            torch.cat([rows[f"{head}/{policy}"] for policy in self.interface.policy_ids], dim=1)  # (k, N)
            for head in (REWARDS, PRESENT, TERMINATED)
        )
        policies, together = self.interface.policies, self.settings.mixer != "none"
        discounts, states, next_states = rows[DISCOUNTS], rows[STATE], rows[NEXT + STATE]
        return {
            team: TeamSteps(
                rewards.index_select(1, columns),
                present.index_select(1, columns),
                terminated.index_select(1, columns),
                discounts,
                states,
                next_states,
                together,
            )
            for team, columns in self.columns.items()
            if any(policies[agent] in learning for agent in self.teams[team])
        }

    def mixer(self, networks: Mapping[str, nn.Module], team: str) -> Mixer:
        """Return a team's mixer, from `networks` or from `targets`."""
        match self.settings.mixer:
            case "qmix":
                return networks[_mixer_name(team)]
            case "vdn":
                return vdn_mixer
        return independent_mixer

    def _values(self, rows: Mapping[str, Tensor], learning: Collection[str]) -> tuple[Tensor, Tensor]:
        """Return the values (k, N) of the taken actions, with gradients, and of the best next actions, without."""
        action_values, best = [], []
        for policy in self.interface.policy_ids:
            network, target = self.networks[policy], self.targets[policy]
            assert isinstance(network, AgentNetwork)
            assert isinstance(target, AgentNetwork)
            play = _AgentRows(
                observations=subcolumns(rows, f"{OBSERVATIONS}/{policy}"),
                next_observations=subcolumns(rows, f"{NEXT}{OBSERVATIONS}/{policy}"),
                recurrent_state=subcolumns(rows, f"{RECURRENT_STATE}/{policy}"),
                actions=rows[f"{ACTIONS}/{policy}"],
                present=rows[f"{PRESENT}/{policy}"],
            )
            if policy in learning:
                network.encoder.update_statistics(flatten_leading(play.observations), play.present.flatten())
            values, online = self._current_and_next(network, play)
            action_values.append(values.gather(-1, play.actions.unsqueeze(-1)).squeeze(-1))
            with torch.no_grad():
                _, valued = self._current_and_next(target, play)
                mask = play.next_observations[ACTION_MASK].flatten(2) if ACTION_MASK in play.next_observations else None
                best_actions = next_actions(online if self.settings.double else None, valued, mask)
                best.append(valued.gather(-1, best_actions.unsqueeze(-1)).squeeze(-1))
        return torch.cat(action_values, dim=1), torch.cat(best, dim=1)

    def _current_and_next(self, network: AgentNetwork, play: _AgentRows) -> tuple[Tensor, Tensor]:
        """Return the values (k, n, actions) of current observations, and of next ones without gradients."""
        if self.settings.recurrence is not None:
            return _sequence_values(network, play, self.settings.recurrence.sequence)
        values = network.values(flatten_leading(play.observations)).unflatten(0, play.present.shape)
        with torch.no_grad():
            return values, network.values(flatten_leading(play.next_observations)).unflatten(0, play.present.shape)


def _sequence_values(network: AgentNetwork, play: _AgentRows, steps: int) -> tuple[Tensor, Tensor]:
    """As `_current_and_next`, on rows (S · T, n, …) unrolled as T steps of S · n agents.

    The initial recurrent state is the stored one from when the agent acted (Kapturowski et al., 2019, "Recurrent
    experience replay in distributed reinforcement learning", stored state).
    """
    agents = play.present.shape[1]

    def in_time(column: Tensor) -> Tensor:
        return column.unflatten(0, (-1, steps)).transpose(0, 1).flatten(1, 2)

    def in_rows(column: Tensor) -> Tensor:
        return column.unflatten(1, (-1, agents)).transpose(0, 1).flatten(0, 1)

    actions, present = in_time(play.actions), in_time(play.present)
    state = {key: in_time(column)[0] for key, column in play.recurrent_state.items()}
    observations = {name: in_time(column) for name, column in play.observations.items()}
    values, hidden = network.unroll(observations, state, actions, present)
    with torch.no_grad():
        next_observations = flatten_leading({name: in_time(column) for name, column in play.next_observations.items()})
        following = network.values_after(next_observations, actions.flatten(), hidden.flatten(0, 1))
    return in_rows(values), in_rows(following.unflatten(0, (steps, -1)))


def team_columns(of_teams: Teams, interface: Interface) -> dict[str, list[int]]:
    """Return team → the indices of its agents among the columns of all policies."""
    order = [
        agent for policy in interface.policy_ids for agent in interface.agents if interface.policies[agent] == policy
    ]
    return {team: [order.index(agent) for agent in members] for team, members in of_teams.items()}


def _mixer_name(team: str) -> str:
    return f"mixer/{team}"
