"""Collects a runner's statistics of play and logs them under RLlib's metric names."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

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

from league.environments.stepping import Indices, Turn
from training.sampling.distributions import Distribution

ENTROPY = "entropy"
"""Mean entropy of the action distributions while sampling, in nats, per policy."""
CRASHES = "crashes"
"""Number of episodes lost because the environment raised."""
EPISODE_MODULE_LEN_MEAN = "module_episode_len_mean"
EPISODE_AGENT_LEN_MEAN = "agent_episode_len_mean"
"""Actions of an agent per episode: mean over the agents of a policy, or of one agent."""


@dataclass(frozen=True, slots=True)
class PlayedEpisodes:
    """Finished episodes.

    lengths: (m,), environment steps, including random and opponents' moves. steps: (m, agents), those of each agent
    that the league's policies played; 0 for an agent that did not finish the episode. returns: (m, agents), of the
    whole episode, 0 where steps is 0.
    """

    lengths: NDArray[np.int64]
    steps: NDArray[np.int64]
    returns: NDArray[np.float64]


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
        # Of each agent in the current episode: until now, and at its end.
        self._returns = np.zeros((num_envs, len(agents)))
        self._steps = np.zeros((num_envs, len(agents)), np.int64)
        self._last_returns, self._last_steps = self._returns.copy(), self._steps.copy()
        self._lengths = np.zeros(num_envs, np.int64)
        self.steps = 0
        """Actions of all agents since the runner started."""
        self.episodes = 0
        """Episodes finished since the runner started."""
        self._logged_steps = self._logged_episodes = 0
        self.logged: PlayedEpisodes | None = None
        """The episodes of the last `log`, if any."""
        self._clear()

    def add_play(self, policy: str, dist_inputs: NDArray) -> None:
        """Add the distribution inputs (k, d) that a policy's actions were drawn from."""
        self._plays[policy].append(dist_inputs)

    def add_moves(self, moves: int) -> None:
        """Add a number of actions, whoever took them."""
        self.steps += moves

    def add_step(self, acting: NDArray[np.bool_]) -> None:
        """Count a step in some environments. acting: (environments,)."""
        self._lengths += acting

    def add_turn(self, turn: Turn, own_policies: int) -> None:
        """Add what has ended, and the rewards of agents that must act.

        own_policies: the first groups are those of the league's own policies.
        """
        if len(turn.crashed):
            self._crashes += len(turn.crashed)
            self.forget(turn.crashed)
        for rows in turn.endings:
            places = rows.envs, rows.agents
            steps = self._steps[places]
            self._last_steps[places] += steps
            # Agents that no policy of the league controlled are ignored.
            self._last_returns[places] += np.where(steps > 0, self._returns[places] + rows.rewards, 0.0)
            self._steps[places] = self._returns[places] = 0
        if len(turn.finished):
            self.episodes += len(turn.finished)
            played = turn.finished[self._last_steps[turn.finished].any(axis=1)]
            if len(played):
                self._finished.append(
                    PlayedEpisodes(self._lengths[played], self._last_steps[played], self._last_returns[played])
                )
            self.forget(turn.finished)
        for group, batch in turn.batches.items():
            self._returns[batch.envs, batch.agents] += batch.rewards
            if group < own_policies:
                self._steps[batch.envs, batch.agents] += 1

    def forget(self, envs: Indices) -> None:
        """Drop the open episodes of some environments."""
        for column in (self._returns, self._steps, self._last_returns, self._last_steps, self._lengths):
            column[envs] = 0

    def log(self, metrics: MetricsLogger) -> None:
        """Log everything since the last call under RLlib's names."""
        steps, episodes = self.steps - self._logged_steps, self.episodes - self._logged_episodes
        metrics.log_value(NUM_ENV_STEPS_SAMPLED, steps, reduce="sum")
        metrics.log_value(NUM_ENV_STEPS_SAMPLED_LIFETIME, steps, reduce="lifetime_sum", with_throughput=True)
        metrics.log_value(NUM_EPISODES, episodes, reduce="sum")
        metrics.log_value(NUM_EPISODES_LIFETIME, episodes, reduce="lifetime_sum")
        metrics.log_value(CRASHES, self._crashes, reduce="sum")
        for policy, plays in self._plays.items():
            dist_inputs = np.concatenate(plays)
            entropy = float(self._distributions[policy].entropy(dist_inputs).mean())
            metrics.log_value((policy, ENTROPY), entropy, window=1)
            metrics.log_value((NUM_MODULE_STEPS_SAMPLED, policy), len(dist_inputs), reduce="sum")
            metrics.log_value((NUM_MODULE_STEPS_SAMPLED_LIFETIME, policy), len(dist_inputs), reduce="lifetime_sum")
        self.logged = self._log_episodes(metrics) if self._finished else None
        self._logged_steps, self._logged_episodes = self.steps, self.episodes
        self._clear()

    def _log_episodes(self, metrics: MetricsLogger) -> PlayedEpisodes:
        finished = PlayedEpisodes(
            np.concatenate([played.lengths for played in self._finished]),
            np.concatenate([played.steps for played in self._finished]),
            np.concatenate([played.returns for played in self._finished]),
        )
        lengths, returns = finished.lengths, finished.returns.sum(axis=1)
        for key, values, statistic in (
            (EPISODE_LEN_MEAN, lengths, np.mean),
            (EPISODE_LEN_MIN, lengths, np.min),
            (EPISODE_LEN_MAX, lengths, np.max),
            (EPISODE_RETURN_MEAN, returns, np.mean),
            (EPISODE_RETURN_MIN, returns, np.min),
            (EPISODE_RETURN_MAX, returns, np.max),
        ):
            metrics.log_value(key, float(statistic(values)), window=1)
        for index, name in enumerate(self._agents):
            steps = _log_means(metrics, EPISODE_AGENT_RETURN_MEAN, EPISODE_AGENT_LEN_MEAN, name, finished, [index])
            if steps:
                metrics.log_value((NUM_AGENT_STEPS_SAMPLED, name), steps, reduce="sum")
                metrics.log_value((NUM_AGENT_STEPS_SAMPLED_LIFETIME, name), steps, reduce="lifetime_sum")
        for policy in dict.fromkeys(self._policies):
            agents = [index for index, agent_policy in enumerate(self._policies) if agent_policy == policy]
            _log_means(metrics, EPISODE_MODULE_RETURN_MEAN, EPISODE_MODULE_LEN_MEAN, policy, finished, agents)
        return finished

    def _clear(self) -> None:
        self._plays: dict[str, list[NDArray]] = defaultdict(list)
        self._finished: list[PlayedEpisodes] = []
        self._crashes = 0


def _log_means(
    metrics: MetricsLogger, return_key: str, length_key: str, name: str, episodes: PlayedEpisodes, agents: list[int]
) -> int:
    """Log the mean return and length of some agents' episodes, and return the number of their steps."""
    steps, returns = episodes.steps[:, agents], episodes.returns[:, agents]
    if not steps.any():
        return 0
    metrics.log_value((return_key, name), float(returns[steps > 0].mean()), window=1)
    metrics.log_value((length_key, name), float(steps[steps > 0].mean()), window=1)
    return int(steps.sum())
