"""PPO learners and episodes of a league, without a running algorithm."""

from collections.abc import Collection
from typing import Any

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


def episodes_of(league: LeagueConfig, taught: Collection[str] = ()) -> list[EpisodeChunks]:
    runner = BatchedEnvRunner(config=algorithm_config(league, interface(league)), worker_index=0)
    try:
        return runner.sample_chunks(num_timesteps=256, taught=taught)
    finally:
        runner.stop()


def update(learner: PPOLearner, episodes: list[EpisodeChunks]) -> dict[str, float]:
    metrics = learner.update(training_data=TrainingData(episodes=episodes), num_epochs=2, minibatch_size=64)
    (policy,) = metrics
    return {name: float(stats.peek()) for name, stats in metrics[policy].items()}
