"""What a runner reports of its play."""

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
"""Mean entropy of the distributions that were played from, in nats, per policy."""
CRASHES = "crashes"
"""Episodes that were lost because the environment raised."""
EPISODE_MODULE_LEN_MEAN = "module_episode_len_mean"
EPISODE_AGENT_LEN_MEAN = "agent_episode_len_mean"
"""Actions of an agent in an episode, mean over the agents of a policy, or of one agent."""


@dataclass(frozen=True, slots=True)
class AgentEpisode:
    """What an agent of the league's own had from an episode: its return counts from the episode's first step on, its
    steps from where its policy took over."""

    agent: int
    steps: int
    return_: float


@dataclass(slots=True)
class PlayedEpisode:
    """steps: of the environment, random and opponents' ones included. agents: the league's own, as they left."""

    steps: int = 0
    agents: list[AgentEpisode] = field(default_factory=list)


class PlayMetrics:
    """Gathers plays and episodes, and logs them in one go: MetricsLogger costs more per value than a game's move."""

    def __init__(
        self,
        agents: tuple[str, ...],
        policies: tuple[str, ...],
        distributions: Mapping[str, Distribution],
        copies: int,
    ) -> None:
        """policies: that of each agent. distributions: what each policy's actions are drawn from."""
        self._agents = agents
        self._policies = policies
        self._distributions = distributions
        self._returns = np.zeros(copies * len(agents))
        self._steps = np.zeros(copies * len(agents), dtype=np.int64)
        self._playing = [PlayedEpisode() for _ in range(copies)]
        self.steps = 0
        """Moves of all agents since the runner began."""
        self.episodes = 0
        """Episodes finished since the runner began."""
        self._logged_steps = self._logged_episodes = 0
        self._clear()

    def add_rows(self, slots: NDArray, rewards: NDArray, are_own: bool) -> None:
        """Agents must act, and have got rewards. slots: copy · agents + agent. are_own: by a policy of the league."""
        self._returns[slots] += rewards
        if are_own:
            self._steps[slots] += 1

    def add_play(self, policy: str, dist_inputs: NDArray) -> None:
        """Actions were drawn by the rows of (k, d) inputs of distributions."""
        self._plays[policy].append(dist_inputs)

    def add_moves(self, moves: int) -> None:
        """So many agents have acted, whoever plays them."""
        self.steps += moves

    def add_step(self) -> None:
        """All copies have taken a step."""
        for episode in self._playing:
            episode.steps += 1

    def add_agent(self, ending: Ending) -> None:
        """An agent has left its episode. One that none of the league's policies played counts for nothing."""
        slot = ending.copy * len(self._agents) + ending.agent
        if self._steps[slot]:
            returned = float(self._returns[slot]) + ending.reward
            self._playing[ending.copy].agents.append(AgentEpisode(ending.agent, int(self._steps[slot]), returned))
        self._steps[slot] = self._returns[slot] = 0

    def add_episode(self, copy: int) -> None:
        """The episode in `copy` is over."""
        self.episodes += 1
        if self._playing[copy].agents:
            self._finished.append(self._playing[copy])
        self.forget(copy)

    def add_crash(self, copy: int) -> None:
        """The environment of `copy` has crashed, and its episode is lost."""
        self._crashes += 1
        self.forget(copy)

    def forget(self, copy: int) -> None:
        """The episode in `copy` is left."""
        self._playing[copy] = PlayedEpisode()
        slots = slice(copy * len(self._agents), (copy + 1) * len(self._agents))
        self._steps[slots] = self._returns[slots] = 0

    def log(self, metrics: MetricsLogger) -> None:
        """Log all since the last call under RLlib's names."""
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
