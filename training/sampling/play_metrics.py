"""What a runner reports of its play."""

from collections import defaultdict

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

from training.sampling import categorical
from training.sampling.transitions import AgentEpisode

ENTROPY = "entropy"
"""Mean entropy of the distributions that were played from, in nats, per policy."""
EPISODE_MODULE_LEN_MEAN = "module_episode_len_mean"
"""Steps of an agent in an episode, mean over the agents of a policy."""


class PlayMetrics:
    """Gathers plays and episodes, and logs them in one go: MetricsLogger costs more per value than a game's move."""

    def __init__(self, agents: tuple[str, ...], policies: tuple[str, ...]) -> None:
        """policies: that of each agent."""
        self._agents = agents
        self._policies = policies
        self._finishing: dict[int, list[AgentEpisode]] = defaultdict(list)
        self.steps = 0
        """Moves since the runner began."""
        self.episodes = 0
        """Episodes finished since the runner began."""
        self._logged_steps = 0
        self._clear()

    def add_play(self, policy: str, log_probabilities: NDArray) -> None:
        """Actions were drawn for the rows of (k, n) log-probabilities."""
        self.steps += len(log_probabilities)
        self._plays[policy].append(log_probabilities)

    def add_opening(self, moves: int) -> None:
        """Random moves were made that belong to an opening: steps of the environment, of no policy."""
        self.steps += moves

    def add_agent(self, copy: int, episode: AgentEpisode) -> None:
        """An agent of the episode in `copy` has left."""
        self._finishing[copy].append(episode)

    def add_episode(self, copy: int) -> None:
        """The episode in `copy` is over."""
        self.episodes += 1
        self._finished.append(self._finishing.pop(copy, []))

    def forget_unfinished(self) -> None:
        """The episodes that are under way are left."""
        self._finishing.clear()

    def log(self, metrics: MetricsLogger) -> None:
        """Log all since the last call under RLlib's names."""
        steps = self.steps - self._logged_steps
        metrics.log_value(NUM_ENV_STEPS_SAMPLED, steps, reduce="sum")
        metrics.log_value(NUM_ENV_STEPS_SAMPLED_LIFETIME, steps, reduce="lifetime_sum", with_throughput=True)
        metrics.log_value(NUM_EPISODES, len(self._finished), reduce="sum")
        metrics.log_value(NUM_EPISODES_LIFETIME, len(self._finished), reduce="lifetime_sum")
        self._log_plays(metrics)
        if self._finished:
            self._log_episodes(metrics)
        self._logged_steps = self.steps
        self._clear()

    def _log_plays(self, metrics: MetricsLogger) -> None:
        for policy, plays in self._plays.items():
            log_probabilities = np.concatenate(plays)
            entropy = float(categorical.entropy(log_probabilities).mean())
            metrics.log_value((policy, ENTROPY), entropy, window=1)
            _log_steps(metrics, NUM_MODULE_STEPS_SAMPLED, policy, len(log_probabilities))
            _log_steps(metrics, NUM_MODULE_STEPS_SAMPLED_LIFETIME, policy, len(log_probabilities))

    def _log_episodes(self, metrics: MetricsLogger) -> None:
        lengths = [sum(agent.steps for agent in episode) for episode in self._finished]
        returns = [sum(agent.return_ for agent in episode) for episode in self._finished]
        for key, values, statistic in (
            (EPISODE_LEN_MEAN, lengths, np.mean),
            (EPISODE_LEN_MIN, lengths, np.min),
            (EPISODE_LEN_MAX, lengths, np.max),
            (EPISODE_RETURN_MEAN, returns, np.mean),
            (EPISODE_RETURN_MIN, returns, np.min),
            (EPISODE_RETURN_MAX, returns, np.max),
        ):
            metrics.log_value(key, float(statistic(values)), window=1)
        agents = [agent for episode in self._finished for agent in episode]
        by_agent, by_policy, lengths_by_policy = defaultdict(list), defaultdict(list), defaultdict(list)
        for agent in agents:
            policy = self._policies[agent.agent]
            by_agent[self._agents[agent.agent]].append(agent)
            by_policy[policy].append(agent.return_)
            lengths_by_policy[policy].append(agent.steps)
        for name, episodes in by_agent.items():
            returned = float(np.mean([episode.return_ for episode in episodes]))
            metrics.log_value((EPISODE_AGENT_RETURN_MEAN, name), returned, window=1)
            steps = sum(episode.steps for episode in episodes)
            _log_steps(metrics, NUM_AGENT_STEPS_SAMPLED, name, steps)
            _log_steps(metrics, NUM_AGENT_STEPS_SAMPLED_LIFETIME, name, steps)
        for policy, values in by_policy.items():
            metrics.log_value((EPISODE_MODULE_RETURN_MEAN, policy), float(np.mean(values)), window=1)
            length = float(np.mean(lengths_by_policy[policy]))
            metrics.log_value((EPISODE_MODULE_LEN_MEAN, policy), length, window=1)

    def _clear(self) -> None:
        self._plays: dict[str, list[NDArray]] = defaultdict(list)
        self._finished: list[list[AgentEpisode]] = []


def _log_steps(metrics: MetricsLogger, key: str, name: str, steps: int) -> None:
    metrics.log_value((key, name), steps, reduce="lifetime_sum" if key.endswith("lifetime") else "sum")
