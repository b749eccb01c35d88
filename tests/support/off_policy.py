"""Runs of DQN and QMIX in this process."""

from collections.abc import Callable
from typing import Any

from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_MODULE_RETURN_MEAN

from league.config.league import LeagueConfig
from league.environments.building import interface
from training.algorithms.off_policy import OffPolicy
from training.algorithms.rllib_config import algorithm_config


def build(league: LeagueConfig) -> OffPolicy:
    algorithm = algorithm_config(league, interface(league)).build_algo()
    algorithm.reset_episodes(0)
    return algorithm


def train(league: LeagueConfig, updates: int, inspect_algorithm: Callable[[OffPolicy, dict[str, Any]], Any]) -> Any:
    """What a function of the algorithm and the result of its last update returns."""
    algorithm = build(league)
    try:
        for _ in range(updates):
            result = algorithm.train()
        return inspect_algorithm(algorithm, result)
    finally:
        algorithm.stop()


def learns(league: LeagueConfig, target: dict[str, float], limit: int) -> bool:
    """Whether the mean return of each policy reaches its target within a number of updates; training ends then."""
    algorithm = build(league)
    try:
        for _ in range(limit):
            means = algorithm.train()[ENV_RUNNER_RESULTS].get(EPISODE_MODULE_RETURN_MEAN, {})
            if target.keys() <= means.keys() and all(means[policy] > value for policy, value in target.items()):
                return True
        return False
    finally:
        algorithm.stop()
