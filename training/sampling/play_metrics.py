"""Collects a runner's statistics of play and logs them under RLlib's metric names."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from ray.rllib.utils.metrics import (
    EPISODE_AGENT_RETURN_MEAN,
    EPISODE_LEN_MAX,
    EPISODE_LEN_MEAN,
    EPISODE_LEN_MIN,
    EPISODE_MODULE_RETURN_MEAN,
    EPISODE_RETURN_MAX,
    EPISODE_RETURN_MEAN,
    EPISODE_RETURN_MIN,
    NUM_AGENT_STEPS_SAMPLED,
    NUM_AGENT_STEPS_SAMPLED_LIFETIME,
    NUM_ENV_STEPS_SAMPLED,
    NUM_ENV_STEPS_SAMPLED_LIFETIME,
    NUM_EPISODES,
    NUM_EPISODES_LIFETIME,
    NUM_MODULE_STEPS_SAMPLED,
    NUM_MODULE_STEPS_SAMPLED_LIFETIME,
)
from ray.rllib.utils.metrics.metrics_logger import MetricsLogger

from league.environments.stepping import Ending
from training.sampling.distributions import Distribution

ENTROPY = "entropy"
"""Mean entropy of the action distributions while sampling, in nats, per policy."""
CRASHES = "crashes"
"""Number of episodes lost because the environment raised."""
EPISODE_MODULE_LEN_MEAN = "module_episode_len_mean"
EPISODE_AGENT_LEN_MEAN = "agent_episode_len_mean"
"""Actions of an agent per episode: mean over the agents of a policy, or of one agent."""


@dataclass(frozen=True, slots=True)
class AgentEpisode:
    """One agent's part of an episode: the return of the whole episode, and the steps that its policy played."""

    agent: int
    steps: int
    return_: float


@dataclass(slots=True)
class PlayedEpisode:
    """steps: of the environment, including random and opponents' moves. agents: those of the league's policies."""

    steps: int = 0
    agents: list[AgentEpisode] = field(default_factory=list)


class PlayMetrics:
    """Collects plays and episodes and logs them in one call: MetricsLogger is slower per value than a game's move."""

    def __init__(
        self,
        agents: tuple[str, ...],
        policies: tuple[str, ...],
        distributions: Mapping[str, Distribution],
        num_envs: int,
    ) -> None:
        """policies: the policy of each agent. distributions: policy id → its action distribution."""
        self._agents = agents
        self._policies = policies
        self._distributions = distributions
        self._returns = np.zeros(num_envs * len(agents))
        self._steps = np.zeros(num_envs * len(agents), dtype=np.int64)
        self._playing = [PlayedEpisode() for _ in range(num_envs)]
        self.steps = 0
        """Actions of all agents since the runner started."""
        self.episodes = 0
        """Episodes finished since the runner started."""
        self._logged_steps = self._logged_episodes = 0
        self._clear()

    def add_rows(self, slots: NDArray, rewards: NDArray, are_own: bool) -> None:
        """Add the rewards of agents that must act. slots: env · agents + agent. are_own: controlled by the league's
        policies."""
        self._returns[slots] += rewards
        if are_own:
            self._steps[slots] += 1

    def add_play(self, policy: str, dist_inputs: NDArray) -> None:
        """Add the distribution inputs (k, d) that a policy's actions were drawn from."""
        self._plays[policy].append(dist_inputs)

    def add_moves(self, moves: int) -> None:
        """Add a number of actions, whoever took them."""
        self.steps += moves

    def add_step(self) -> None:
        """Count a step in all environments."""
        for episode in self._playing:
            episode.steps += 1

    def add_agent(self, ending: Ending) -> None:
        """Add an agent that left its episode; ignored if no policy of the league controlled it."""
        slot = ending.env * len(self._agents) + ending.agent
        if self._steps[slot]:
            returned = float(self._returns[slot]) + ending.reward
            self._playing[ending.env].agents.append(AgentEpisode(ending.agent, int(self._steps[slot]), returned))
        self._steps[slot] = self._returns[slot] = 0

    def add_episode(self, env: int) -> None:
        """Add a finished episode."""
        self.episodes += 1
        if self._playing[env].agents:
            self._finished.append(self._playing[env])
        self.forget(env)

    def add_crash(self, env: int) -> None:
        """Add a crash, whose episode is lost."""
        self._crashes += 1
        self.forget(env)

    def forget(self, env: int) -> None:
        """Drop the open episode of an environment."""
        self._playing[env] = PlayedEpisode()
        slots = slice(env * len(self._agents), (env + 1) * len(self._agents))
        self._steps[slots] = self._returns[slots] = 0

    def log(self, metrics: MetricsLogger) -> None:
        """Log everything since the last call under RLlib's names."""
        steps, episodes = self.steps - self._logged_steps, self.episodes - self._logged_episodes
        metrics.log_value(NUM_ENV_STEPS_SAMPLED, steps, reduce="sum")
        metrics.log_value(NUM_ENV_STEPS_SAMPLED_LIFETIME, steps, reduce="lifetime_sum", with_throughput=True)
        metrics.log_value(NUM_EPISODES, episodes, reduce="sum")
        metrics.log_value(NUM_EPISODES_LIFETIME, episodes, reduce="lifetime_sum")
        metrics.log_value(CRASHES, self._crashes, reduce="sum")
        self._log_plays(metrics)
        if self._finished:
            self._log_episodes(metrics)
            self._log_agents(metrics)
        self._logged_steps, self._logged_episodes = self.steps, self.episodes
        self._clear()

    def _log_plays(self, metrics: MetricsLogger) -> None:
        for policy, plays in self._plays.items():
            dist_inputs = np.concatenate(plays)
            entropy = float(self._distributions[policy].entropy(dist_inputs).mean())
            metrics.log_value((policy, ENTROPY), entropy, window=1)
            metrics.log_value((NUM_MODULE_STEPS_SAMPLED, policy), len(dist_inputs), reduce="sum")
            metrics.log_value((NUM_MODULE_STEPS_SAMPLED_LIFETIME, policy), len(dist_inputs), reduce="lifetime_sum")

    def _log_episodes(self, metrics: MetricsLogger) -> None:
        lengths = [episode.steps for episode in self._finished]
        returns = [sum(agent.return_ for agent in episode.agents) for episode in self._finished]
        for key, values, statistic in (
            (EPISODE_LEN_MEAN, lengths, np.mean),
            (EPISODE_LEN_MIN, lengths, np.min),
            (EPISODE_LEN_MAX, lengths, np.max),
            (EPISODE_RETURN_MEAN, returns, np.mean),
            (EPISODE_RETURN_MIN, returns, np.min),
            (EPISODE_RETURN_MAX, returns, np.max),
        ):
            metrics.log_value(key, float(statistic(values)), window=1)

    def _log_agents(self, metrics: MetricsLogger) -> None:
        by_agent, by_policy = defaultdict(list), defaultdict(list)
        for agent in (agent for episode in self._finished for agent in episode.agents):
            by_agent[self._agents[agent.agent]].append(agent)
            by_policy[self._policies[agent.agent]].append(agent)
        for name, episodes in by_agent.items():
            _log_means(metrics, EPISODE_AGENT_RETURN_MEAN, EPISODE_AGENT_LEN_MEAN, name, episodes)
            steps = sum(episode.steps for episode in episodes)
            metrics.log_value((NUM_AGENT_STEPS_SAMPLED, name), steps, reduce="sum")
            metrics.log_value((NUM_AGENT_STEPS_SAMPLED_LIFETIME, name), steps, reduce="lifetime_sum")
        for policy, episodes in by_policy.items():
            _log_means(metrics, EPISODE_MODULE_RETURN_MEAN, EPISODE_MODULE_LEN_MEAN, policy, episodes)

    def _clear(self) -> None:
        self._plays: dict[str, list[NDArray]] = defaultdict(list)
        self._finished: list[PlayedEpisode] = []
        self._crashes = 0


def _log_means(
    metrics: MetricsLogger, return_key: str, length_key: str, name: str, episodes: Sequence[AgentEpisode]
) -> None:
    metrics.log_value((return_key, name), float(np.mean([episode.return_ for episode in episodes])), window=1)
    metrics.log_value((length_key, name), float(np.mean([episode.steps for episode in episodes])), window=1)
