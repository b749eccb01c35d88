"""PPO learners and episodes of a league, without a running algorithm."""

from collections.abc import Collection
from typing import Any

import numpy as np
from ray.rllib.core.learner.training_data import TrainingData

from league.config.league import LeagueConfig
from league.environments.building import interface
from training.algorithms.rllib_config import algorithm_config
from training.learners.ppo import PPOLearner
from training.sampling.env_runner import BatchedEnvRunner
from training.sampling.episode_chunks import EpisodeChunks


def learner_of(league: LeagueConfig, **options: Any) -> PPOLearner:
    config = algorithm_config(league, interface(league), **options)
    learner = PPOLearner(config=config, module_spec=config.rl_module_spec)
    learner.build()
    return learner


def episodes_of(league: LeagueConfig, taught: Collection[str] = (), steps: int = 256) -> list[EpisodeChunks]:
    runner = BatchedEnvRunner(config=algorithm_config(league, interface(league)), worker_index=0)
    try:
        return runner.sample_chunks(num_timesteps=steps, taught=taught)
    finally:
        runner.stop()


def update(learner: PPOLearner, episodes: list[EpisodeChunks], **options: Any) -> dict[str, dict[str, float]]:
    """The metrics of each policy that learns."""
    settings: dict[str, Any] = {"num_epochs": 2, "minibatch_size": 64} | options
    metrics = learner.update(training_data=TrainingData(episodes=episodes), **settings)
    return {policy: {name: float(stats.peek()) for name, stats in row.items()} for policy, row in metrics.items()}


def weights(learner: PPOLearner) -> dict[str, dict[str, np.ndarray]]:
    return {policy: module.get_state() for policy, module in learner.module.items()}


def equal(first: Any, second: Any) -> bool:
    """Exact equality of nested states."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(equal(value, second[key]) for key, value in first.items())
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(equal, first, second))
    return bool(np.array_equal(first, second))
